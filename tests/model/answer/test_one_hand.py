"""Fingers of one hand, too near for contents of their own, beside somebody else on the plate."""

import math
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from model.answer.answer import MIN_CONTRAST_DB
from model.answer.stimulus import ANY, BY_NAME, MUST, NEVER, Finger, Stimulus
from model.rig.rig_file import load_rig
from model.table.table_file import build_table
from set_table import drives
from set_table import phased as answer

PAPER_PLATE = Path(__file__).parents[3] / "examples" / "paper_plate.yaml"
APART, AWAY, EDGE = 0.021, 0.09, 0.02
"""Of the fingers on a hand, of somebody else from these, and of all from the edge [m]."""


@cache
def table():
    """Of four ERAs with the errors of parts as bought."""
    return build_table(load_rig(PAPER_PLATE))


def hands(count):
    """Three fingers in a row, 2.1 cm apart, and one of somebody else at least 9 cm from them."""
    rng, found = np.random.default_rng(1), []
    length, width = table().plate.length, table().plate.width

    def anywhere():
        return rng.uniform(EDGE, [length - EDGE, width - EDGE])

    while len(found) < count:
        middle, angle, far = anywhere(), rng.uniform(0, 2 * math.pi), anywhere()
        along = APART * np.array([math.cos(angle), math.sin(angle)])
        hand = middle + np.outer([-1, 0, 1], along)
        is_inside = (hand >= EDGE).all() and (hand <= [length - EDGE, width - EDGE]).all()
        if is_inside and np.linalg.norm(hand - far, axis=1).min() >= AWAY:
            found.append([(float(x), float(y)) for x, y in (*hand, far)])
    return found


def fingers(places, *, sharing=BY_NAME, is_one=False):
    """Each with a content of another name, or the hand's of one; the last is somebody else's."""
    names = "aaad" if is_one else "abcd"
    wanted = [Stimulus(14, name=name) for name in names]
    how = [*[MUST if is_one else sharing] * 3, BY_NAME]
    given = zip(places, wanted, how, strict=True)
    return [Finger(at, stimulus, sharing=sharing) for at, stimulus, sharing in given]


def is_served(felt):
    """Whether a finger feels its own content, 6 dB above all others on nine of ten plates."""
    return felt.verdict in ("own", "mixed") and felt.promised_contrast_db >= MIN_CONTRAST_DB


@pytest.mark.parametrize("first", ["hand", "far"])
def test_a_hand_of_three_contents_silences_nobody(first):
    """Whom one content on the hand would leave served is served beside three, in any order."""
    order = [0, 1, 2, 3] if first == "hand" else [3, 0, 1, 2]
    would = 0
    for places in hands(8):
        alike = answer(table(), fingers(places, is_one=True))
        would += is_served(alike.fingers[3])
        found = answer(table(), [fingers(places)[each] for each in order])
        *hand, far = [found.fingers[order.index(each)] for each in range(4)]
        assert is_served(far) or not is_served(alike.fingers[3])
        assert [each.verdict for each in hand[1:]] == ["shared", "shared"]
        assert is_served(hand[0])
        assert len({each.layer for each in hand}) == 1
        assert found.promised_worst_db == pytest.approx(alike.promised_worst_db, abs=1.0)
    assert would == 8


def test_a_hand_that_may_not_share_gives_way():
    """Its contents, which no plan serves, are held back for the one that all of them can stay off.

    Where somebody else is not there, what is best is played at the hand.
    """
    for places in hands(8):
        asked = fingers(places, sharing=NEVER)
        found = answer(table(), asked)
        assert is_served(found.fingers[3])
        assert [each.verdict for each in found.fingers[:3]] == ["held back"] * 3
    assert "mixed" in {each.verdict for each in answer(table(), asked[:3]).fingers}


def test_a_content_beside_a_quiet_finger_of_its_hand_gives_way():
    """Two fingers of a hand that feel nothing: the third's content is held back, nobody else's."""
    for places in hands(8):
        own = fingers(places)
        found = answer(table(), [own[0], own[3]], [Finger(at) for at in places[1:3]])
        assert found.fingers[0].verdict == "held back"
        assert is_served(found.fingers[1])


def test_fingers_that_can_be_apart_do_not_share():
    """Of another name 9 cm away: what does not fit is held back, the newest first."""
    places = [(0.03, 0.03), (0.15, 0.03), (0.27, 0.03), (0.03, 0.12), (0.15, 0.12), (0.27, 0.12)]
    asked = [Finger(at, Stimulus(14, name=str(n))) for n, at in enumerate(places)]
    found = answer(table(), asked)
    verdicts = [each.verdict for each in found.fingers]
    assert "shared" not in verdicts
    served = [n for n, verdict in enumerate(verdicts) if verdict != "held back"]
    assert served[0] == 0
    for n in {*range(6)} - {*served}:
        # With those served before it, all others quiet, it has less than all must have.
        before = [each for each in served if each < n]
        trial = [asked[each] for each in (*before, n)]
        quiet = [Finger(each.at) for each in asked if each not in trial]
        assert answer(table(), trial, quiet, min_contrast_db=-99).promised_worst_db < 6


def test_what_may_share_and_is_near_is_one_drive():
    """Fingers that allow any content have one, as those that cannot be kept apart."""
    places = hands(1)[0]
    may, near = (answer(table(), fingers(places, sharing=how)) for how in (ANY, BY_NAME))
    assert drives(may) == drives(near)
