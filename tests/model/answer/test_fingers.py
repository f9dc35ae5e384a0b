"""Fingers and stimuli: what is refused, and what a vibration for some of them has."""

import math
from dataclasses import replace

import numpy as np
import pytest

from model.answer.answer import Limits
from model.answer.plan import answer, query
from model.answer.stimulus import Finger, Placement, Stimulus, check_fingers, together
from model.ensemble.draws import ClockErrors
from model.errors import InputError
from model.finger import Grid, detection_threshold, fingertip_points, fingertip_weights
from plates import PAPER_TABLE_FREQUENCIES, contact_sets, smooth_table
from set_table import only

TARGET, QUIET = (0.09, 0.07), ((0.25, 0.18),)


@pytest.mark.parametrize(
    "placed",
    [
        Placement(()),
        Placement((TARGET,), tuple((x, y / 50) for x in (0.2, 0.24) for y in range(10))),
        Placement((TARGET, (0.2, 0.1), TARGET)),
        Placement((TARGET,), QUIET * 2),
        Placement((TARGET,), (TARGET,)),
        Placement(((0.2, 0.1), TARGET), ((0.095, 0.07),)),
        Placement((TARGET,), loads=(1.0, 1.0)),
        *(Placement((TARGET,), loads=(load,)) for load in (0.0, -1.0, math.nan, math.inf)),
        Placement(((0.1, math.inf),)),
        Placement((TARGET,), ((math.nan, 0.1),)),
    ],
    ids=str,
)
def test_fingers_that_contradict_each_other_are_refused(placed):
    """Their number, loads, places on top of each other, and off the plate."""
    plate = smooth_table().plate
    check_fingers(together(Placement((TARGET, (0.095, 0.07)), QUIET), Stimulus()), plate)
    with pytest.raises(InputError):
        check_fingers(together(placed, Stimulus()), plate)


@pytest.mark.parametrize(
    "more",
    [
        {"level_db_sl": math.nan},
        {"level_db_sl": 60.5},
        {"level_db_sl": -300.0},
        {"level_db_sl": 10**400},
        {"duration": 0.0},
        {"duration": 1e-9},
        {"duration": 10**400},
        {"is_limit": "no"},
        {"duration": math.inf},
        {"duration": 0.04, "modulation_hz": 20.0},
        {"drive_mode": "loud"},
        {"band_hz": (600.0, 800.0)},
    ],
    ids=str,
)
def test_stimuli_that_no_table_has_are_refused(more):
    """Levels, durations and modes that there are not, and frequencies that the table lacks."""
    with pytest.raises(InputError):
        query(smooth_table(), Placement((TARGET,)), **more)


@pytest.mark.parametrize(
    "given",
    [
        {"priority": 10**400},
        {"priority": 1 << 31},
        {"priority": -(1 << 31) - 1},
        {"load": 10**400},
        {"min_contrast_db": math.nan},
        {"sharing": np.array([1, 2])},
        {"is_protected": "no"},
    ],
    ids=lambda given: next(iter(given)),
)
def test_what_no_finger_asks_is_refused(given):
    """Numbers that no plate or kernel has, and values that are no answer to the question."""
    with pytest.raises(InputError):
        answer(smooth_table(), [Finger(TARGET, Stimulus(), **given)])


@pytest.mark.parametrize(
    ("targets", "quiet", "mode"),
    [
        ((TARGET,), QUIET, "phased"),
        ((TARGET, (0.2, 0.1)), (), "phased"),
        ((TARGET, (0.2, 0.1)), (), "switched"),
    ],
)
def test_a_level_out_of_reach_is_lowered_to_one_in_reach(targets, quiet, mode):
    """Some ERA is at full stroke, and the level that it says is reached when it is asked for."""
    table, placed = smooth_table(), Placement(targets, quiet)
    low = {"band_hz": (60.0, 80.0), "drive_mode": mode}
    found = query(table, placed, 60.0, **low)
    felt = min(found.fingers[: len(targets)], key=lambda each: each.promised_level_db_sl)
    assert felt.lowered_db == pytest.approx(60.0 - found.fingers[0].promised_level_db_sl, abs=0.01)
    assert 20 < felt.promised_level_db_sl < 60
    assert not found.is_reached
    assert ["lowered" in each for each in found.applied][-1]
    full = max(found.amplitudes[name] / table.full_levels[name] for name in found.amplitudes)
    assert full == pytest.approx(1.0, abs=1e-5)
    assert query(table, placed, felt.promised_level_db_sl - 0.2, **low).is_reached


def test_a_limit_is_as_strong_as_quiet_fingers_allow():
    """These are at -10 dB SL on nine of ten plates, or the limit is reached, in both modes."""
    table, near = smooth_table(), (0.14, 0.09)
    for mode in ("switched", "phased"):
        for quiet, bound in (((near,), True), ((), False)):
            finger = Finger(TARGET, Stimulus(26.0, is_limit=True))
            found = answer(table, [finger], quiet=quiet, drive_mode=mode)
            felt = found.fingers[0]
            if bound:
                assert found.fingers[1].foreign_level_db_sl == pytest.approx(-10.0, abs=1e-3)
                assert felt.level_db_sl < 26.0
            else:
                assert felt.level_db_sl == pytest.approx(26.0, abs=1e-3)
            assert felt.lowered_db == pytest.approx(26.0 - felt.promised_level_db_sl, abs=1e-3)


@pytest.mark.parametrize("slew", [math.inf, 0.3, 0.1])
def test_a_click_that_is_a_limit_stays_so_along_the_ramp_that_the_slew_needs(slew: float):
    """Quiet fingers have -10 dB SL at most; it does not return to the level of its search."""
    click = Finger(TARGET, Stimulus(26.0, duration=0.04, is_limit=True))
    for quiet in contact_sets(6, fingers=2, seed=5):
        if min(math.dist(at, TARGET) for at in quiet) < 0.02:
            continue
        found = answer(
            smooth_table(), [click], quiet=quiet, drive_mode="phased", limits=Limits(slew=slew)
        )
        assert max(each.foreign_level_db_sl for each in found.fingers[1:]) <= -10.0 + 1e-3


def test_a_limit_is_not_lowered_for_what_others_play():
    """Of the other vibration nothing counts; beside no quiet finger both have their levels."""
    limit = Finger(TARGET, Stimulus(26.0, is_limit=True))
    other = Finger((0.05, 0.17), Stimulus(20.0))
    found = answer(smooth_table(), [limit, other], drive_mode="phased")
    assert [each.verdict in ("own", "mixed") for each in found.fingers] == [True, True]
    assert found.fingers[0].promised_level_db_sl >= 12.0 - 1e-3
    near = (0.14, 0.09)
    alone = answer(smooth_table(), [limit], quiet=[near, other.at], drive_mode="phased")
    beside = answer(
        smooth_table(), [limit, other], quiet=[near], drive_mode="phased", min_contrast_db=-99.0
    )
    assert beside.fingers[2].foreign_level_db_sl > -10.0
    levels = [found.fingers[0].promised_level_db_sl for found in (alone, beside)]
    assert levels[1] > levels[0] - 3.0


def test_frequencies_are_those_of_the_band():
    """From 150 to 250 Hz no tone lies outside, in any mode; the ends of a band are in it."""
    for mode in ("switched", "phased"):
        layer, _ = only(
            smooth_table(), Placement((TARGET,), QUIET), drive_mode=mode, band_hz=(150.0, 250.0)
        )
        assert all(150 <= tone.frequency <= 250 for tone in layer.excitation.values())
    end = float(PAPER_TABLE_FREQUENCIES[9])
    layer, _ = only(smooth_table(), Placement((TARGET,), QUIET), band_hz=(end, end))
    assert layer.frequency == end


def test_query_gives_the_strongest_era_phase_zero():
    """No phase is absolute; the others are relative to the strongest."""
    for place, *quiet in contact_sets(4, fingers=3, seed=12):
        layer, _ = only(smooth_table(), Placement((place,), tuple(quiet)), drive_mode="phased")
        strongest = max(layer.excitation.values(), key=lambda tone: tone.amplitude)
        assert strongest.phase == 0.0
        assert sum(tone.phase == 0.0 for tone in layer.excitation.values()) == 1


def test_query_reaches_the_level_at_both_targets():
    """Both at the level or above, the weaker one as predicted."""
    table = smooth_table()
    first, second, quiet = contact_sets(1, fingers=3, seed=9)[0]
    found = query(table, Placement((first, second), (quiet,)), 15.0, drive_mode="phased")
    levels = []
    for place in (first, second):
        points = fingertip_points(*place, table.plate)
        frequencies, amplitudes = table.amplitudes(
            found.layers[0].excitation, points, contacts=(first, second, quiet)
        )
        above = np.sqrt(((amplitudes.T / detection_threshold(frequencies)) ** 2).sum(axis=1))
        levels.append(20 * np.log10(above @ fingertip_weights(*place, table.plate)))
    felt = found.fingers[:2]
    assert [each.level_db_sl for each in felt] == pytest.approx(levels, abs=0.01)
    assert min(each.promised_level_db_sl for each in felt) == pytest.approx(15.0, abs=0.1)
    assert felt[1].verdict == "shared"


@pytest.mark.parametrize("mode", ["switched", "phased"])
def test_the_grid_of_summaries_decides_no_answer(mode):
    """A lone finger feels the same whatever it is."""
    table = smooth_table()
    expected, _ = only(table, Placement((TARGET,)), drive_mode=mode)
    for cells in ((1, 1), (2, 2), (6, 4), (30, 20)):
        other = replace(table, grid=Grid(*cells))
        found, _ = only(other, Placement((TARGET,)), drive_mode=mode)
        assert found == expected


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
    found = query(table, Placement(targets), drive_mode=mode)
    layer, felt = found.layers[0], found.fingers[: len(targets)]
    centres = table.cell_centres
    far = centres[[min(math.dist(centre, each) for each in targets) > 0.05 for centre in centres]]
    frequencies, amplitudes = table.amplitudes(layer.excitation, far)
    above = ((amplitudes.T / detection_threshold(frequencies)) ** 2).sum(axis=1)
    around = 10 * np.log10(above.mean())
    level = min(each.level_db_sl for each in felt)
    assert layer.contrast_to_plate_db == pytest.approx(level - around, abs=0.01)
    assert {each.contrast_db for each in felt} == {None}


@pytest.mark.parametrize("level", [14.0, 60.0])
def test_a_switched_content_keeps_to_one_amplifier_where_clocks_are_not_held(level):
    """ERAs of two play at once where they are held together; a level in reach, and one beyond."""
    exact, spans = smooth_table(), list[list[int]]()
    for table in (exact, exact.with_clocks(ClockErrors((0, 1, 0, 1), (0.0, math.inf)))):
        spans.append([])
        for target, quiet in contact_sets(6, fingers=2, seed=3):
            placed = Placement((target,), (quiet,))
            (layer,) = query(table, placed, level, drive_mode="switched").layers
            names = [era.name for era in table.eras]
            spans[-1].append(len({names.index(name) % 2 for name in layer.excitation}))
    assert max(spans[0]) == 2
    assert spans[1] == [1] * 6
