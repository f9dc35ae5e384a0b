"""Levels over limited durations, against the plate in time sample by sample, and their limits."""

import math
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.promise.clicks import clicks_on, given
from model.answer.effect_level import DriveLimits, EffectLevels, pulse_ramp, shaped_gain_db
from model.answer.pattern import Pattern
from model.answer.question import Question
from model.finger.fingertip import fingertip_points, fingertip_weights
from model.finger.perception import detection_threshold
from model.transients.base_motion import ramped_onset, ramped_pulse
from model.transients.measures import SAMPLE_RATE, Transients
from model.vibration.excitation import Excitation, Tone
from paper_table import smooth_rig, smooth_table
from small_table import small_table

TARGET, QUIET = (0.09, 0.07), (0.24, 0.17)
ALONE = Question((TARGET,))
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


@pytest.mark.parametrize("loads", [(), (2.5, 0.4)])
@pytest.mark.parametrize("frequency", [60.0, 110.0, 250.0])
@pytest.mark.parametrize("duration", [0.02, 0.04, 0.15])
def test_gain_is_that_of_the_plate_in_time(
    frequency: float, duration: float, loads: tuple[float, ...]
) -> None:
    """Root mean square of samples over the duration, relative to a second later, within 0.5 dB.

    Under a finger; and over as long at the loudest point of another one, both on the plate, at its
    strongest up to the end and the ringing after it. A carrier of 60 Hz has little more than a
    period in 20 ms, where its own phase counts: 1.5 dB.
    """
    table = small_table()
    drive, ramp = excitation(frequency), pulse_ramp(duration)
    question = Question((TARGET,), (QUIET,), loads=loads)
    gains = EffectLevels(table).gains_db(drive, question, ramp=ramp, duration=duration)
    points = [fingertip_points(*at, table.plate) for at in (TARGET, QUIET)]
    plate = Transients(table.in_time_under((TARGET, QUIET), loads))
    acceleration = plate.acceleration(
        ramped_onset(drive, table.eras, ramp=ramp), points[0], duration=2.0
    )
    pulse = ramped_pulse(drive, table.eras, ramp=ramp, duration=duration)
    after = max(0.5 * duration, 0.02)
    beside = plate.acceleration(pulse, points[1], duration=duration + after)
    weights = fingertip_weights(*TARGET, table.plate)
    count = round(duration * SAMPLE_RATE)
    first = np.sqrt((acceleration[:count] ** 2).mean(axis=0))
    steady = np.sqrt((acceleration[-round(0.5 * SAMPLE_RATE) :] ** 2).mean(axis=0))
    lag = 20 * math.log10(first @ weights / (steady @ weights))
    sums = np.vstack([np.zeros(len(points[1])), np.cumsum(beside**2, axis=0)])
    strongest = np.sqrt((sums[count:] - sums[:-count]).max() / count)
    quiet = math.sqrt(2) * strongest / detection_threshold(np.array(frequency))
    tolerance = 1.5 if frequency * duration < 2 else 0.5
    assert gains.targets == pytest.approx([lag], abs=tolerance)
    assert gains.quiet_db_sl == pytest.approx(20 * math.log10(quiet), abs=tolerance + 0.3)


@pytest.mark.parametrize("frequency", [60.0, 110.0, 250.0])
def test_responses_of_each_era_make_those_of_a_drive(frequency: float) -> None:
    """Weighted sums of coarse responses, within half a decibel of the drive solved finely."""
    table, question = small_table(), Question((TARGET,), (QUIET,))
    levels, drive = EffectLevels(table), excitation(frequency)
    row = table.frequencies.tolist().index(frequency)
    weights = [drive[era.name].phasor / STROKE if era.name in drive else 0.0 for era in table.eras]
    responses = levels.responses(np.array([row]), question=question, duration=0.04)
    found = responses.gains([(row, np.array(weights, dtype=np.complex64))])
    fine = levels.gains_db(drive, question, ramp=0.01, duration=0.04)
    assert found.targets == pytest.approx(fine.targets, abs=0.5)
    assert fine.quiet_db_sl is not None
    # Five points in place of 21.
    assert found.quiet_db_sl == pytest.approx(fine.quiet_db_sl, abs=1.0)


def test_shaped_gain_is_that_of_a_raised_cosine() -> None:
    """By quadrature: the mean square of ((1 - cos) / 2)^2 over 40 ms, then 1 up to the end."""
    times = (np.arange(100_000) + 0.5) / 100_000 * 0.2
    rise = (1 - np.cos(np.pi * np.minimum(times / 0.04, 1))) / 2
    assert shaped_gain_db(0.2) == pytest.approx(10 * math.log10((rise**2).mean()), abs=1e-4)


def raised(limits: DriveLimits, *, level_db_sl: float = 20.0) -> tuple[Pattern, float, float]:
    """The raised pattern, its felt level, and the level 0..1 of SW."""
    raised = EffectLevels(small_table()).raised(
        pattern(), ALONE, level_db_sl=level_db_sl, duration=0.04, limits=limits
    )
    found, felt = raised.pattern, raised.level_db_sl
    assert raised.held_back_db == 0
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
    (lag,) = (
        EffectLevels(small_table())
        .gains_db(found.excitation, ALONE, ramp=0.01, duration=0.04)
        .targets
    )
    assert felt == pytest.approx(20 + 20 * math.log10(level / 0.2) + lag, abs=0.01)


def test_ramp_is_as_long_as_the_rise_of_levels_allows() -> None:
    """A level of 0.2 at most 8 per second takes 25 ms instead of 10."""
    slow, _, level = raised(replace(DriveLimits(FULL), slew=8.0))
    assert slow.ramp == pytest.approx(level / 8.0, rel=0.1)
    assert slow.ramp > 0.02


@pytest.mark.parametrize(
    ("below", "lowers", "raised_db"),
    [
        (8.0, False, 2.0),  # at least 6 dB below the effect with the raise
        (5.0, False, 0.0),  # more than half without a raise: not lowered
        (5.0, True, -1.0),  # another answer may be
        (7.0, False, 1.0),
    ],
)
def test_quiet_fingers_limit_a_raise(below: float, lowers: bool, raised_db: float) -> None:
    """Of 2 dB more as much as leaves them 6 dB below the wanted level over the duration.

    below: how far they are below it without a raise, by what they feel at their strongest.
    """
    levels, question = EffectLevels(small_table()), Question((TARGET,), (QUIET,))
    gains = levels.gains_db(excitation(110.0), question, ramp=0.01, duration=0.04)
    assert gains.quiet_db_sl is not None
    wanted = gains.quiet_db_sl + below
    answer = levels.raised(
        replace(pattern(wanted - 2.0 - gains.targets[0]), quiet_level_db_sl=0.0),
        question,
        level_db_sl=wanted,
        duration=0.04,
        limits=DriveLimits(FULL, lowers=lowers),
    )
    raised = 20 * math.log10(answer.pattern.excitation["SW"].amplitude / (0.2 * STROKE))
    assert raised == pytest.approx(raised_db, abs=1e-6)
    assert answer.held_back_db == pytest.approx(2.0 - raised_db)


def test_better_known_plates_do_not_hold_an_effect_back() -> None:
    """What is promised of the steady vibration does not limit a raise, only what is felt."""
    levels, question = EffectLevels(small_table()), Question((TARGET,), (QUIET,))
    found = [
        levels.raised(
            replace(
                pattern(),
                quiet_level_db_sl=20.0 - nominal,
                robust_felt_contrast_db=robust,
            ),
            question,
            level_db_sl=20.0,
            duration=0.04,
            limits=DriveLimits(FULL),
        ).level_db_sl
        for nominal, robust in ((20.0, 10.0), (20.0, 15.0), (20.0, 20.0), (40.0, 40.0))
    ]
    assert found == sorted(found)


def test_promise_over_a_click_is_kept() -> None:
    """On 240 plates in time, of other thickness, springs, losses and drives: by nine of ten."""
    rig = smooth_rig()
    clicks = clicks_on(smooth_table(), 12, seed=3)
    promised = np.array([each.promised_contrast_db for _, each in clicks])
    found = given(smooth_table(), rig, clicks, 20, seed=4)
    assert 0.86 <= np.mean(found >= promised[:, None]) <= 0.94
