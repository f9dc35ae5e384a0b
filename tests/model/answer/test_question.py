"""Questions and answers: what is refused, what is measured."""

import math
from dataclasses import replace

import numpy as np
import pytest

from model.answer.pattern import Pattern
from model.answer.pattern_query import UnreachableLevel, find_pattern
from model.answer.question import Question
from model.errors import InputError
from model.finger.fingertip import fingertip_points, fingertip_weights
from model.finger.grid import Grid
from model.finger.perception import detection_threshold
from paper_table import FREQUENCIES, contact_sets, smooth_table

TARGET, QUIET = (0.09, 0.07), ((0.25, 0.18),)


@pytest.mark.parametrize(
    "arguments",
    [
        {"targets": ()},
        {"quiet": tuple((x, y / 50) for x in (0.2, 0.24) for y in range(10))},
        {"level_db_sl": math.nan},
        {"level_db_sl": 201.0},
        {"level_db_sl": -300.0},
        {"targets": (TARGET, (0.2, 0.1), TARGET)},
        {"quiet": QUIET * 2},
        {"quiet": (TARGET,)},
        {"targets": ((0.2, 0.1), TARGET), "quiet": ((0.095, 0.07),)},
        {"drive_mode": "loud"},
        {"loads": (1.0, 1.0)},
        {"loads": (0.0,)},
        {"loads": (-1.0,)},
        {"loads": (math.nan,)},
        {"loads": (math.inf,)},
    ],
    ids=str,
)
def test_question_refuses_what_no_table_can_answer(arguments):
    """Numbers of contacts, levels and modes; contacts on top of each other."""
    Question((TARGET,), QUIET)
    with pytest.raises(InputError):
        Question(**{"targets": (TARGET,)} | arguments)


@pytest.mark.parametrize(
    "question",
    [
        Question(((0.1, math.inf),)),
        Question((TARGET,), ((math.nan, 0.1),)),
        Question((TARGET,), drive_mode="phased", playable=("switched",)),
        Question((TARGET,), playable=("phased",)),
        Question((TARGET,), frequencies=(600.0, 800.0)),
    ],
)
def test_query_refuses_what_table_or_amplifiers_lack(question):
    """Contacts off the plate; modes and frequencies that cannot be driven."""
    with pytest.raises(InputError):
        find_pattern(smooth_table(), question)


@pytest.mark.parametrize(
    ("question", "is_exhaustive"),
    [
        (Question((TARGET,), QUIET, drive_mode="phased"), True),
        (Question((TARGET, (0.2, 0.1)), drive_mode="phased"), False),
        (Question((TARGET, (0.2, 0.1))), True),
    ],
)
def test_query_names_a_level_that_is_reached_when_too_loud(question, is_exhaustive):
    """The error says whether the level it names is the highest, and that level has a pattern."""
    with pytest.raises(UnreachableLevel) as refusal:
        find_pattern(smooth_table(), replace(question, level_db_sl=120.0))
    assert refusal.value.is_exhaustive == is_exhaustive
    reachable = refusal.value.reachable_db_sl
    assert 20 < reachable < 120
    assert find_pattern(smooth_table(), replace(question, level_db_sl=reachable))


def test_query_uses_frequencies_that_the_amplifiers_play():
    """With amplifiers from 150 to 250 Hz no tone lies outside, in any mode."""
    for mode in ("switched", "phased"):
        pattern = find_pattern(
            smooth_table(), Question((TARGET,), QUIET, drive_mode=mode, frequencies=(150.0, 250.0))
        )
        assert all(150 <= tone.frequency <= 250 for tone in pattern.excitation.values())
    only = float(FREQUENCIES[9])  # an amplifier's lowest and highest are among what it plays
    pattern = find_pattern(smooth_table(), Question((TARGET,), QUIET, frequencies=(only, only)))
    assert {tone.frequency for tone in pattern.excitation.values()} == {only}


def test_pattern_derives_measures_from_levels():
    """By hand: 20 dB SL here and 4 there are 16 between; unaware at -10, so up to 6 is usable."""
    pattern = Pattern({}, 0.02, 20.0, 15.0, 4.0)
    assert pattern.felt_contrast_db == 16.0
    assert pattern.is_imperceptible_to_quiet is False
    assert pattern.usable_level_db_sl == 6.0
    doubtful = replace(pattern, robust_quiet_level_db_sl=7.0)
    assert doubtful.usable_level_db_sl == 3.0
    deaf = replace(pattern, quiet_level_db_sl=-10.0)
    assert deaf.is_imperceptible_to_quiet is True
    assert deaf.usable_level_db_sl == 20.0
    alone = replace(pattern, contrast_db=None, quiet_level_db_sl=None)
    assert alone.is_imperceptible_to_quiet is None
    assert alone.usable_level_db_sl == 20.0


def test_query_gives_the_strongest_era_phase_zero():
    """No phase is absolute; the others are relative to the strongest."""
    for place, *quiet in contact_sets(4, fingers=3, seed=12):
        pattern = find_pattern(
            smooth_table(), Question((place,), tuple(quiet), drive_mode="phased")
        )
        strongest = max(pattern.excitation.values(), key=lambda tone: tone.amplitude)
        assert strongest.phase == 0.0
        assert sum(tone.phase == 0.0 for tone in pattern.excitation.values()) == 1


def test_query_reaches_the_level_at_both_targets():
    """Both at the level or above, the weaker one as predicted."""
    table = smooth_table()
    first, second, quiet = contact_sets(1, fingers=3, seed=9)[0]
    question = Question((first, second), (quiet,), drive_mode="phased", level_db_sl=15.0)
    pattern = find_pattern(table, question)
    levels = []
    for place in (first, second):
        points = fingertip_points(*place, table.plate)
        frequencies, amplitudes = table.amplitudes(
            pattern.excitation, points, contacts=(first, second, quiet)
        )
        above = np.sqrt(((amplitudes.T / detection_threshold(frequencies)) ** 2).sum(axis=1))
        levels.append(20 * np.log10(above @ fingertip_weights(*place, table.plate)))
    assert min(levels) == pytest.approx(pattern.level_db_sl, abs=0.01)
    assert pattern.robust_level_db_sl == pytest.approx(15.0)
    assert pattern.level_db_sl > 15.0


@pytest.mark.parametrize("mode", ["switched", "phased"])
def test_the_grid_of_summaries_decides_no_answer(mode):
    """A lone finger feels the same whatever it is."""
    table = smooth_table()
    question = Question((TARGET,), drive_mode=mode)
    expected = find_pattern(table, question)
    for cells in ((1, 1), (2, 2), (6, 4), (30, 20)):
        found = find_pattern(replace(table, grid=Grid(*cells)), question)
        assert found.excitation == expected.excitation
        assert found.surroundings_contrast_db == expected.surroundings_contrast_db


@pytest.mark.parametrize(
    ("targets", "mode"),
    [
        *(((TARGET,), mode) for mode in ("switched", "phased")),
        ((TARGET, QUIET[0]), "phased"),
    ],
)
def test_query_without_quiet_fingers_contrasts_with_the_plate_around(targets, mode):
    """The ratio of levels to the rms of cell centres beyond 5 cm of every target is in the answer.

    The plate around is that without fingers, which change it little.
    """
    table = smooth_table()
    pattern = find_pattern(table, Question(targets, drive_mode=mode))
    centres = table.cell_centres
    far = centres[[min(math.dist(centre, each) for each in targets) > 0.05 for centre in centres]]
    frequencies, amplitudes = table.amplitudes(pattern.excitation, far)
    above = ((amplitudes.T / detection_threshold(frequencies)) ** 2).sum(axis=1)
    around = 10 * np.log10(above.mean())
    assert pattern.surroundings_contrast_db == pytest.approx(pattern.level_db_sl - around, abs=0.01)
    assert pattern.contrast_db is None
    assert pattern.quiet_level_db_sl is None
