"""What moving fingers are answered for, and what is promised of it."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from controller.play.intent import Target
from controller.play.joint_answers import (
    MARGIN_DB,
    STRETCH,
    answered,
    felt_on_ways,
    selection_of,
    with_ways,
)
from controller.sources.touch import AT_REST, Contact, ContactKey, Motion
from model.answer.plan import answer
from model.answer.stimulus import Finger, Stimulus
from several_fingers import LAYOUT, LEFT, RIGHT, fingers_on, playable, table
from virtual_lines import in_virtual_time

MOVER, OTHER = (0.10, 0.08), (0.22, 0.12)
NOW = 5.0


def contact(number: int, at: tuple[float, float], vx: float = 0.0, vy: float = 0.0) -> Contact:
    """A contact with a velocity [m/s], at its place now, reported every 10 ms."""
    motion = AT_REST
    for step in range(-5, 1):
        time = 0.01 * step
        motion = motion.followed(NOW + time, at[0] + vx * time, at[1] + vy * time)
    return Contact(ContactKey("a", number), *at, since=0.0, motion=motion)


def fingers(contacts: Sequence[Contact]) -> list[Finger]:
    """Fingers at the contacts, each with a stimulus of its own."""
    return [Finger((each.x, each.y), Stimulus(14.0, name=str(each.key.id))) for each in contacts]


def test_a_moving_finger_is_answered_for_the_next_8_mm() -> None:
    """At 0.2 m/s 20 ms until it plays and 20 until weights have half changed: 8, 12, 16 mm on."""
    contacts = [contact(1, MOVER, vx=0.2), contact(2, OTHER)]
    middle, other, first, last = with_ways(fingers(contacts), contacts, NOW, table().plate)
    assert [each.at[0] - MOVER[0] for each in (first, middle, last)] == pytest.approx(
        [0.008, 0.012, 0.016]
    )
    assert math.dist(first.at, last.at) == pytest.approx(STRETCH)
    assert other == fingers(contacts)[1]
    assert sum(each.load for each in (first, middle, last)) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("at", "vx", "stimulus", "count"),
    [
        (MOVER, 0.02, Stimulus(14.0), 2),  # slower than 50 mm/s
        (MOVER, 0.2, None, 4),  # as quiet for all others
        ((table().plate.length - 0.005, 0.08), 0.2, Stimulus(14.0), 2),  # its way ends at the edge
        ((OTHER[0] - 0.02, OTHER[1]), 0.2, Stimulus(14.0), 2),  # it would meet the other
        (MOVER, 0.2, Stimulus(14.0, modulation_hz=20.0), 2),
        (MOVER, 0.2, Stimulus(14.0, name="2"), 2),  # which both may share
    ],
)
def test_ends_of_ways_are_fingers_where_they_can_be(
    at: tuple[float, float], vx: float, stimulus: Stimulus | None, count: int
) -> None:
    """Else the finger alone, on the plate; any of these is answered."""
    contacts = [contact(1, at, vx=vx), contact(2, OTHER)]
    given = [Finger(at, stimulus), fingers(contacts)[1]]
    found = with_ways(given, contacts, NOW, table().plate)
    assert len(found) == count
    assert len(answer(table(), found, drive_mode="phased").fingers) == count


def test_what_is_promised_is_the_least_on_the_way_and_2_db_less() -> None:
    """Of three places that are answered as fingers of their own; beside it 2 dB less as well."""
    contacts = [contact(1, MOVER, vx=0.2), contact(2, OTHER)]
    targets = [(each, Target(each.key, 14.0, content=str(each.key.id))) for each in contacts]
    found = answered(table(), targets, (), playable(), before={}, now=NOW)
    middle, other, *ends = found.fingers
    promised = [each.promised_contrast_db or 0.0 for each in (middle, *ends)]
    levels = [each.promised_level_db_sl for each in (middle, *ends)]
    moving, resting = selection_of(table(), found, targets, (), before={}).predictions
    assert moving.promised_contrast_db == pytest.approx(min(promised) - MARGIN_DB)
    assert moving.level_db_sl == pytest.approx(min(levels))
    assert resting.promised_contrast_db == pytest.approx((other.promised_contrast_db or 0) - 2.0)
    assert resting.foreign_level_db_sl == pytest.approx((other.foreign_level_db_sl or 0) + 2.0)
    assert len(found.layers) == 2
    assert felt_on_ways(found, 4) == [*found.fingers]


def test_a_promise_for_a_way_holds_at_places_between() -> None:
    """Nominal contrast at nine places of the next 8 mm, by fields of the table, in both contents.

    At a place that the answer is not for, 30 mm behind, it does not.
    """
    contacts = [contact(1, MOVER, vx=0.2), contact(2, OTHER)]
    targets = [(each, Target(each.key, 14.0, content=str(each.key.id))) for each in contacts]
    found = answered(table(), targets, (), playable(), before={}, now=NOW)
    moving, _ = selection_of(table(), found, targets, (), before={}).predictions
    least = []
    for way in [*(0.008 + 0.001 * step for step in range(9)), -0.022]:
        at = (MOVER[0] + way, MOVER[1])
        own, foreign = (
            max(
                abs(
                    table().amplitudes(layer.excitation, np.array([at]), contacts=[at, OTHER])[1]
                ).ravel()
            )
            / float(table().thresholds[found.tones.rows[number]])
            for number, layer in enumerate(found.layers)
        )
        least.append(20 * math.log10(own / foreign))
    assert min(least[:-1]) >= (moving.promised_contrast_db or 0.0)
    assert least[-1] < min(least[:-1])


def test_a_finger_that_rests_is_answered_where_it_is() -> None:
    """Also one that moved until 60 ms ago, of which its source says nothing since."""
    moved = contact(1, MOVER, vx=0.2)
    contacts = [moved, replace(contact(2, OTHER), motion=Motion())]
    assert with_ways(fingers(contacts), contacts, NOW + 0.06, table().plate) == fingers(contacts)


@pytest.mark.parametrize(("way", "count"), [(0.2, 1), (0.04, 0)])
@in_virtual_time
async def test_a_finger_that_sets_out_is_answered_before_it_has_gone_8_mm(
    way: float, count: int
) -> None:
    """At 0.2 m/s its slope over 60 ms is 3 mm after 20 ms; at 40 mm/s it rests."""
    async with fingers_on(table(), LAYOUT, at={1: LEFT, 2: RIGHT}, held=1.5) as fingers:
        before = len(fingers.applied)

        def move(since: float) -> None:
            fingers.at[1] = (LEFT[0] - way * since, LEFT[1])

        await fingers.hold(0.035, move)
        assert len(fingers.applied) - before == count
