"""Levels over limited durations, against the plate in time sample by sample, and their limits."""

import math
from dataclasses import replace

import numpy as np
import pytest

from model.finger.fingertip import fingertip_points, fingertip_weights
from model.table.effect_level import DriveLimits, EffectLevels, pulse_ramp, shaped_gain_db
from model.table.pattern import Pattern
from model.transients.envelope import ramped_onset
from model.transients.measures import SAMPLE_RATE, Transients
from model.vibration.excitation import Excitation, Tone
from small_table import small_table

TARGET = (0.09, 0.07)
STROKE = 100e-6  # m


def excitation(frequency: float, *, level: float = 0.2) -> Excitation:
    """Two ERAs, out of phase."""
    return {
        "SW": Tone(frequency, level * STROKE, 0.3),
        "NE": Tone(frequency, 0.5 * level * STROKE, -1.1),
    }


def pattern(level_db_sl: float = 20.0, *, level: float = 0.2) -> Pattern:
    """A pattern of that drive which says that it reaches a level."""
    return Pattern(excitation(110.0, level=level), 0.04, level_db_sl, None, None)


@pytest.mark.parametrize("frequency", [60.0, 110.0, 250.0])
@pytest.mark.parametrize("duration", [0.02, 0.04, 0.15])
def test_gain_is_that_of_the_plate_in_time(frequency: float, duration: float) -> None:
    """Root mean square of samples over the duration, relative to a second later, within 0.5 dB.

    A carrier of 60 Hz has little more than a period in 20 ms, where its own phase counts: 1.5 dB.
    """
    table = small_table()
    drive, ramp = excitation(frequency), pulse_ramp(duration)
    (found,) = EffectLevels(table).gain_db(drive, ramp=ramp, duration=duration, targets=[TARGET])
    acceleration = Transients(table.in_time).acceleration(
        ramped_onset(drive, table.eras, ramp=ramp),
        fingertip_points(*TARGET, table.plate),
        duration=2.0,
    )
    weights = fingertip_weights(*TARGET, table.plate)
    count = round(duration * SAMPLE_RATE)
    first = np.sqrt((acceleration[:count] ** 2).mean(axis=0)) @ weights
    steady = np.sqrt((acceleration[-round(0.5 * SAMPLE_RATE) :] ** 2).mean(axis=0)) @ weights
    tolerance = 1.5 if frequency * duration < 2 else 0.5
    assert found == pytest.approx(20 * math.log10(first / steady), abs=tolerance)


def test_shaped_gain_is_that_of_a_raised_cosine() -> None:
    """By quadrature: the mean square of ((1 - cos) / 2)^2 over 40 ms, then 1 up to the end."""
    times = (np.arange(100_000) + 0.5) / 100_000 * 0.2
    rise = (1 - np.cos(np.pi * np.minimum(times / 0.04, 1))) / 2
    assert shaped_gain_db(0.2) == pytest.approx(10 * math.log10((rise**2).mean()), abs=1e-4)


def raised(limits: DriveLimits, *, level_db_sl: float = 20.0) -> tuple[Pattern, float, float]:
    """The raised pattern, its felt level, and the level 0..1 of SW."""
    found, felt = EffectLevels(small_table()).raised(
        pattern(), level_db_sl=level_db_sl, duration=0.04, targets=[TARGET], limits=limits
    )
    return found, felt, found.excitation["SW"].amplitude / STROKE


FULL = {"SW": STROKE, "NE": STROKE}


def test_drive_is_raised_by_the_lag() -> None:
    """Felt as requested; drive and steady level rise alike, on the ramp of the duration."""
    found, felt, level = raised(DriveLimits(FULL))
    assert felt == pytest.approx(20.0)
    assert found.level_db_sl - 20.0 == pytest.approx(20 * math.log10(level / 0.2))
    assert found.ramp == pulse_ramp(0.04) == 0.01


@pytest.mark.parametrize(
    ("limits", "level"),
    [
        (DriveLimits(FULL), 1.0),
        (DriveLimits({"SW": 0.6 * STROKE, "NE": STROKE}), 0.6),
        (DriveLimits({"SW": STROKE, "NE": 0.2 * STROKE}), 0.4),
        (DriveLimits(FULL, power=0.3125), 0.5),  # 0.5^2 + 0.25^2
    ],
)
def test_drive_stays_within_its_limits(limits: DriveLimits, level: float) -> None:
    """Of 40 dB more it gives what they allow, and says how much is felt."""
    found, felt, reached = raised(limits, level_db_sl=60.0)
    assert reached == pytest.approx(level, rel=1e-3)
    (lag,) = EffectLevels(small_table()).gain_db(
        found.excitation, ramp=0.01, duration=0.04, targets=[TARGET]
    )
    assert felt == pytest.approx(20 + 20 * math.log10(level / 0.2) + lag, abs=0.01)


def test_ramp_is_as_long_as_the_rise_of_levels_allows() -> None:
    """A level of 0.2 at most 8 per second takes 25 ms instead of 10."""
    slow, _, level = raised(replace(DriveLimits(FULL), slew=8.0))
    assert slow.ramp == pytest.approx(level / 8.0, rel=0.1)
    assert slow.ramp > 0.02
