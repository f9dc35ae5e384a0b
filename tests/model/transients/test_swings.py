"""Magnets that are pumped by levels that swing, worked out for coils that are held."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lsim

from model.answer.answer import swings_of_pulse
from model.answer.stimulus import Course
from model.reduction.free_plate import solve_free_plate
from model.transients.excursions import (
    CLICKS_APART,
    MagnetMotions,
    Swing,
    magnets_of,
    motions_along,
)
from plates import exciter_rig

K, C, M, BL, R, VOLTS = 3189.2, 0.7553, 0.10929, 3.63, 4.4, 3.0008
"""Of the exciter of 25 mm at 1 W, from its sheet: 27 Hz and a quality of 5 on a held coil."""


def held() -> MagnetMotions:
    """Four on a board that weighs 240 times as much as their magnets."""
    keys = "type: DAEX25FHE-4, power: 1 W, stiffness: 3189.2, damping: 0.7553, inductance: 0"
    rig = exciter_rig(keys)
    heavy = replace(rig.plate.material, E=1e13, rho=3e5)
    rig = replace(rig, plate=replace(rig.plate, material=heavy))
    return magnets_of(rig, solve_free_plate(rig.plate, rig.mesh, frequency_max=300.0))


def by_hand(frequency: float, swing: Swing) -> float:
    """Largest |x| of M x'' + (c + Bl^2 / R) x' + k x = Bl V e(t) exp(i w t) / R."""
    ends = swing.step * np.arange(len(swing.shares))
    times = np.arange(0, ends[-1], 2e-4)
    level = BL * VOLTS / R * np.interp(times, ends, swing.shares)
    push, mass = level * np.exp(2j * math.pi * frequency * times), ([1.0], [M, C + BL**2 / R, K])
    parts = [lsim(mass, each, times)[1] for each in (push.real, push.imag)]
    return float(np.hypot(*parts).max())


@pytest.mark.parametrize("frequency", [40.0, 47.0])
def test_motion_along_a_level_that_swings_is_that_of_one_mass(frequency: float) -> None:
    """At the beat of drive and magnet the level moves it further than one that lasts."""
    magnets, times = held(), 0.01 * np.arange(61)
    wave = (1 - np.cos(2 * math.pi * (frequency - 27.2) * times)) / 2
    for shares in (wave, np.minimum(times / 0.01, 1)):
        swing = Swing(tuple(shares.tolist()), 0.01)
        found = motions_along(magnets.plate, magnets.rows, frequency, swing)
        assert found == pytest.approx([by_hand(frequency, swing)] * 4, rel=0.02)


def test_pulses_over_and_over_add_up_where_they_come_at_the_worst_pace() -> None:
    """The worst of trains whose pauses are tried one by one; a single one moves it less."""
    magnets, frequency = held(), 40.0
    single, _ = swings_of_pulse(0.04, 0.01)
    once, largest = replace(single, again=math.inf), 0.0
    for pause in range(60, 120, 4):
        train = np.zeros(900)
        for start in range(0, 500, pause):
            part = single.shares[: len(train) - start]
            train[start : start + len(part)] += part
        largest = max(largest, by_hand(frequency, Swing(tuple(train.tolist()), 0.001)))
    assert single.again == CLICKS_APART == 0.06
    found = motions_along(magnets.plate, magnets.rows, frequency, single)
    assert found == pytest.approx([largest] * 4, rel=0.05)
    alone = motions_along(magnets.plate, magnets.rows, frequency, once)
    assert found[0] > 1.1 * alone[0]


def test_courses_swing_as_they_are_played_from_knot_to_knot() -> None:
    """Of 95 swings a second knots every 10 ms leave 5, once and then over and over."""
    times = np.arange(0.0, 0.6, 0.001)
    shares = (1 + np.cos(2 * math.pi * 95 * times)) / 2
    swing = Course(tuple(times.tolist()), tuple(shares.tolist())).swings[0]
    found = np.array(swing.shares)
    expected = (1 + np.cos(2 * math.pi * 5 * swing.step * np.arange(1, 60))) / 2
    assert swing.step == 0.01
    assert found[1:60] == pytest.approx(expected, abs=1e-6)
    assert (found[60:85] == 0).all()
    assert found[85:].max() > 0.99
