"""Settled patterns, and the alarm that follows them."""

from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest

from benchmarks.identification.hidden import draw
from model.arrays import FloatArray
from model.identification.forward import Sensor
from model.identification.learned_plate import LivePlate, PlateEstimate
from model.identification.settled_patterns import (
    WINDOW,
    Alarm,
    NoiseLevel,
    Observation,
    PatternModel,
    SettledPattern,
    State,
    StateUpdate,
    update,
)
from model.rig.rig_file import example_rig_path, load_rig
from plates import settled_patterns


@pytest.fixture(scope="module")
def known() -> PlateEstimate:
    """The paper's plate by its drawing."""
    rig = load_rig(example_rig_path())
    return PlateEstimate.of_rig(rig, [Sensor(era.name, era.name) for era in rig.eras])


@pytest.fixture(scope="module")
def pattern() -> SettledPattern:
    """One of another plate."""
    hidden = draw("form", 1)
    (one,) = settled_patterns(hidden, hidden.mounted, count=1, start=0)
    return one


def turned(pattern: SettledPattern, phase: float, *, has_phase: bool) -> SettledPattern:
    """The pattern, read from another moment on."""
    return replace(pattern, values=np.exp(1j * phase) * pattern.values, has_phase=has_phase)


def state_after(known: PlateEstimate, pattern: SettledPattern) -> FloatArray:
    """Parameters after the pattern."""
    live = LivePlate(known)
    live.take(pattern)
    return live.known.state.x


def test_update_does_not_depend_on_a_phase_that_is_unknown(
    known: PlateEstimate, pattern: SettledPattern
) -> None:
    """A turn of all readings together changes nothing; where their phase counts, it does."""
    before = state_after(known, turned(pattern, 0.0, has_phase=False))
    after = state_after(known, turned(pattern, 2.0, has_phase=False))
    np.testing.assert_allclose(after, before, atol=1e-9)
    counted = state_after(known, turned(pattern, 2.0, has_phase=True))
    assert np.abs(counted - before).max() > 0.1


def test_update_within_bounds_explains_a_pattern(
    known: PlateEstimate, pattern: SettledPattern
) -> None:
    """Of a plate that was not measured, whose ERAs at corners can be off inwards alone.

    A hundred parameters are free for eight numbers: at the most likely state these are explained to
    their errors, by no more changes than eight directions of the prior are likely to make.
    """
    model = PatternModel.of(known.model, pattern, 0.5)
    found = update(known.state, [model], evaluations=20)
    predicted, _ = model.predicted(found.state.x, found.fingers)
    residuals = (predicted - pattern.numbers) / model.std
    assert residuals @ residuals < found.count
    assert found.cost < 3 * found.count
    space = known.model.space
    assert (found.state.x >= space.lower).all()
    assert (found.state.x <= space.upper).all()


def test_numbers_change_as_their_derivatives_say(
    known: PlateEstimate, pattern: SettledPattern
) -> None:
    """Central differences of the numbers without a phase; none lies along a common turn."""
    without = turned(pattern, 1.0, has_phase=False)
    model = PatternModel.of(known.model, without, 0.5)
    x, fingers = np.zeros(known.model.space.size), np.zeros(4 * len(pattern.fingers))
    _, J = model.predicted(x, fingers)
    step = 1e-5
    for number in known.model.space.indices("stiffness"):
        moved = x.copy()
        moved[number] = step
        ahead, _ = model.predicted(moved, fingers)
        behind, _ = model.predicted(-moved, fingers)
        slopes = (ahead - behind) / (2 * step)
        np.testing.assert_allclose(slopes, J[:, number], rtol=1e-3, atol=1e-7)
    turn = np.concatenate([(1j * without.values).real, (1j * without.values).imag])
    assert np.abs(turn @ J).max() < 1e-9 * np.linalg.norm(turn) * np.linalg.norm(J)


def taken(*, nis: float = 2.0, slope: float = 0.0, masses: int = 0) -> Observation:
    """A pattern of eight numbers with one direction of unit curvature."""
    slopes, none = np.array([slope]), cast(Any, None)
    return Observation(none, none, 0.0, nis, 8, slopes, np.ones(1), masses)


def updated(misfit: float, freedom: float) -> StateUpdate:
    """An update that leaves so many squared residuals of so many numbers."""
    empty = np.zeros((0, 0))
    state = State(np.zeros(0), empty)
    return StateUpdate(state, 0.0, 8, 0.0, misfit, freedom, empty, empty, empty, empty)


def test_change_along_one_direction_is_found_in_likely_patterns() -> None:
    """Four patterns 2.4 deviations off along a direction are 4.8 together, though each is likely.

    The patterns before them are left out.
    """
    alarm = Alarm()
    before = [taken() for _ in range(5)]
    off = [taken(slope=2.4) for _ in range(4)]
    assert [alarm.take(each) for each in (*before, *off[:3])] == [None] * 8
    assert alarm.take(off[3]) == off


def test_deviations_that_change_their_sign_are_none() -> None:
    """Deviations of 2.4 up and down cancel."""
    alarm = Alarm()
    assert all(alarm.take(taken(slope=2.4 * (-1) ** n)) is None for n in range(2 * WINDOW))


def test_mass_can_only_be_added() -> None:
    """A mass less than none raises no alarm."""
    alarm = Alarm()
    assert all(alarm.take(taken(slope=-2.4, masses=1)) is None for _ in range(WINDOW))


def test_unlikely_innovations_raise_an_alarm() -> None:
    """Of chi² of 32 120 has a probability of 4e-12."""
    alarm = Alarm()
    found = [alarm.take(taken(nis=30.0)) for _ in range(4)]
    assert found[-1] is not None


def test_one_unlikely_pattern_raises_none() -> None:
    """A finger unlike any other is odd, alone and among others, but no change of the plate."""
    alarm = Alarm()
    assert alarm.take(taken(nis=90.0, slope=9.0)) is None
    assert alarm.is_odd
    assert all(alarm.take(taken()) is None for _ in range(WINDOW))
    assert not alarm.is_odd


def test_noise_follows_what_is_left_within_its_bounds() -> None:
    """Residuals of half their size halve the noise; it is 0.3 at least and 1 at most."""
    for size, expected in ((0.5, 0.5), (0.01, 0.3), (3.0, 1.0)):
        noise = NoiseLevel()
        for _ in range(200):
            noise.take(updated(4 * (size / noise.relative) ** 2, 4.0))
        assert noise.relative == pytest.approx(expected, rel=0.05)
