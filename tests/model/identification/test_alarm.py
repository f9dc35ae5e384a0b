"""Alarms of a plate in service, and the noise that they count from."""

from typing import Any, cast

import numpy as np
import pytest

from model.identification.alarm import WINDOW, Alarm, Taken
from model.identification.kalman import State, Updated
from model.identification.noise import NoiseLevel


def taken(*, nis: float = 2.0, slope: float = 0.0, masses: int = 0) -> Taken:
    """A pattern of eight numbers with one direction of unit curvature."""
    slopes, none = np.array([slope]), cast(Any, None)
    return Taken(none, none, 0.0, nis, 8, slopes, np.ones(1), masses)


def updated(misfit: float, freedom: float) -> Updated:
    """An update that leaves so many squared residuals of so many numbers."""
    empty = np.zeros((0, 0))
    state = State(np.zeros(0), empty)
    return Updated(state, 0.0, 8, 0.0, misfit, freedom, empty, empty, empty, empty)


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
