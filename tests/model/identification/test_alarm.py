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
    """Four patterns 2.8 deviations off along a direction are 5.6 together, though each is likely.

    The patterns before them are left out.
    """
    alarm = Alarm()
    before = [taken() for _ in range(5)]
    off = [taken(slope=2.8) for _ in range(4)]
    assert [alarm.take(each) for each in (*before, *off[:3])] == [None] * 8
    assert alarm.take(off[3]) == off


def test_deviations_that_change_their_sign_are_none() -> None:
    """Deviations of 2.8 up and down cancel."""
    alarm = Alarm()
    assert all(alarm.take(taken(slope=2.8 * (-1) ** n)) is None for n in range(2 * WINDOW))


def test_mass_can_only_be_added() -> None:
    """A mass less than none raises no alarm."""
    alarm = Alarm()
    assert all(alarm.take(taken(slope=-2.8, masses=1)) is None for _ in range(WINDOW))


@pytest.mark.parametrize(("squares", "count"), [(60.0, 1), (30.0, 4)])
def test_unlikely_innovations_raise_an_alarm(squares: float, count: int) -> None:
    """Of chi² of 8 60 has a probability of 5e-10, of chi² of 32 120 one of 4e-12."""
    alarm = Alarm()
    found = [alarm.take(taken(nis=squares)) for _ in range(count)]
    assert found[-1] is not None


def test_noise_follows_what_is_left_within_its_bounds() -> None:
    """Residuals of half their size halve the noise; it is 0.3 at least and 1 at most."""
    for size, expected in ((0.5, 0.5), (0.01, 0.3), (3.0, 1.0)):
        noise = NoiseLevel()
        for _ in range(200):
            noise.take(updated(4 * (size / noise.relative) ** 2, 4.0))
        assert noise.relative == pytest.approx(expected, rel=0.05)
