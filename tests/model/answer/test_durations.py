"""Clicks and envelopes: levels felt over limited durations, against the plate in time."""

import math
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.promise.clicks import clicks_on
from benchmarks.promise.clicks import given as contrasts_on_drawn_plates
from kit.plates import contact_sets, small_table, smooth_rig, smooth_table
from model.answer.answer import Limits
from model.answer.envelope import (
    COURSE_KNOT_STEP,
    Course,
    DriveEnvelope,
    pulse_ramp,
)
from model.answer.plan import answer, query
from model.answer.ringing import RingingUnderFingers, on_drawn_plates
from model.answer.stimulus import Finger, Placement, Stimulus
from model.arrays import FloatArray
from model.finger import detection_threshold, fingertip_points, fingertip_weights
from model.table.table import LocalizationTable
from model.transients.base_motion import (
    BaseEnvelope,
    Bases,
    ramped_onset,
    ramped_pulse,
    rise,
    shaped,
)
from model.transients.shaping import SAMPLE_RATE, Transients
from model.vibration import Excitation, Tone, base_amplitudes

TARGET = (0.09, 0.07)
QUIET = (0.24, 0.17)
FINGERS = (TARGET, QUIET)
LOADS = (2.5, 0.4)
"""The first finger presses harder than the rig's fingertip, the second more lightly."""
STROKE = 100e-6  # m


def in_db(amplitude: float) -> float:
    """Return 20 log10 of an amplitude ratio."""
    return 20 * math.log10(amplitude)


def drive_of_two_eras(frequency: float) -> Excitation:
    """Return two tones that are out of phase."""
    return {
        "SW": Tone(frequency, 0.2 * STROKE, 0.3),
        "NE": Tone(frequency, 0.1 * STROKE, -1.1),
    }


def course_along(duration: float, shares: FloatArray) -> Course:
    """Return a course through shares at equally spaced times of a duration [s]."""
    times = np.linspace(0, duration, len(shares)).tolist()
    clipped = np.clip(shares, 0, 1).tolist()
    return Course(tuple(times), tuple(clipped))


# Envelopes

BOTH_ENDS = Course((0, 0.02, 0.0201, 0.08, 0.0801, 0.1), (1, 1, 0, 0, 1, 1))
MEAN_SQUARES_OF_40_MS = {
    "plateau": (Course((0, 0.5), (0.5, 0.5)), 1 / 4),
    # (1 - t / 40 ms)^2 over 20 ms on each side of the peak
    "triangle": (Course((0, 0.04, 0.08), (0, 1, 0)), 7 / 12),
    # a rise within 2 ms has a mean square of 1/3
    "brief": (Course((0, 0.002), (0, 1)), 1 / 60),
    "20 ms at both ends": (BOTH_ENDS, 1 / 2),
    "20 ms at both ends of a loop": (replace(BOTH_ENDS, repeats=True), 1),
    "silence": (Course((0, 0.1), (0, 0)), 1e-12),
}
"""Courses and the mean squares of their strongest 40 ms, by hand."""


@pytest.mark.parametrize("name", MEAN_SQUARES_OF_40_MS)
def test_strongest_moments_of_a_course_are_40_ms(name: str) -> None:
    """Twenty milliseconds at both ends meet only in a loop; silence is -120 dB."""
    course, mean_square = MEAN_SQUARES_OF_40_MS[name]

    assert course.strongest_db == pytest.approx(10 * math.log10(mean_square), abs=0.03)


@pytest.mark.parametrize("modulation", [20.0, 2.0])
def test_sinusoidal_modulation_has_three_tones(modulation: float) -> None:
    """Beats that come and go along a raised cosine of 8 s.

    Each side tone has half the amplitude of the carrier, less what playback along lines between
    knots takes away. Slow changes are hardly felt next to a null: side bands at 2 Hz are a fifth of
    the way to the next tone, of whose power they cause 1/25. At the top of a beat the carrier has
    half of the amplitude, each side band a quarter.
    """
    times = np.linspace(0, 8.0, 1601)
    slow = (1 - np.cos(2 * np.pi * times / 8.0)) / 2
    beats = (1 - np.cos(2 * np.pi * modulation * times)) / 2
    offsets = np.arange(-60.0, 61.0, 10.0)  # Hz, from the carrier

    shares = DriveEnvelope.of_course(course_along(8.0, slow * beats)).shares_at(offsets)

    if modulation == 2.0:
        next_tones = shares[np.abs(offsets) == 10]
        assert next_tones == pytest.approx(0.25**2 / 25, rel=0.1)
    else:
        # a sinusoid at its knots, and at the middle of each line between two of them
        played = (1 + np.cos(np.pi * modulation * COURSE_KNOT_STEP)) / 2
        expected = np.where(offsets == 0, 1.0, 0.0)
        expected[np.abs(offsets) == modulation] = (played / 2) ** 2
        np.testing.assert_allclose(shares / shares.max(), expected, atol=0.01)


# Predictions and the plate in time


def mean_squares(samples: FloatArray, duration: float) -> FloatArray:
    """Return the mean squares (windows, points) of samples (times, points) over a duration [s]."""
    count = round(duration * SAMPLE_RATE)
    energies = np.zeros((len(samples) + 1, samples.shape[1]))
    np.cumsum(samples**2, axis=0, out=energies[1:])
    windows: FloatArray = (energies[count:] - energies[:-count]) / count
    return windows


def accelerations(
    table: LocalizationTable, bases: Bases, duration: float, loads: tuple[float, ...] = ()
) -> FloatArray:
    """Return the accelerations (fingers, times, points) of the plate in time under fingers."""
    plate = Transients(table.in_time_under(FINGERS, loads))
    fingertips = [fingertip_points(*place, table.plate) for place in FINGERS]
    samples = plate.acceleration(bases, np.concatenate(fingertips), duration=duration)
    by_finger = samples.reshape(len(samples), len(FINGERS), -1)
    return by_finger.swapaxes(0, 1)


def felt_level(amplitudes: FloatArray) -> FloatArray:
    """Return the mean of amplitudes (..., points) over the target's fingertip."""
    return np.asarray(amplitudes @ fingertip_weights(*TARGET, small_table().plate))


def predicted_gain_and_crosstalk(envelope: DriveEnvelope, drive: Excitation) -> tuple[float, float]:
    """Return the target's gain and the loudest power at the quiet finger, both in dB."""
    table = small_table()
    frequencies, bases = base_amplitudes(drive, table.eras)
    ringing = RingingUnderFingers(table, FINGERS, LOADS, envelope)
    predicted = ringing.over(zip(frequencies.tolist(), bases, strict=True))
    crosstalk = math.sqrt(predicted.heard[1].max())
    return in_db(predicted.gains[0]), in_db(crosstalk)


def strokes() -> FloatArray:
    """Three strokes, the second half as long as the first and the last faint, as designers draw."""
    rising = rise(0.005 * np.arange(161), 0.040)
    falling = 1 - rise(0.005 * np.arange(161) - 0.3, 0.040)
    shares = np.asarray(rising * falling)
    shares[80:100] += 0.8 * rising[:20] * rising[:20][::-1]
    shares[120:160] += 0.3 * rising[:40] * rising[:40][::-1]
    return shares


STROKES = course_along(0.8, strokes())
"""Knots 5 ms apart, as in all of these courses."""
JUMP = course_along(1.2, np.concatenate([[0.0], np.linspace(1, 0, 200), np.zeros(40)]))
"""From 0 to 1 within 5 ms, and from there down to 0 over a second."""
LOOP = replace(course_along(0.12, np.linspace(1, 0, 25)), repeats=True)
"""Falls from 1 to 0 and repeats: strongest around the start of a turn."""
TURNS = 8
"""Turns of the loop, by the end of which all turns are alike."""


def motion_along(course: Course, drive: Excitation) -> Bases:
    """Return bases that follow a course through its knots 10 ms apart, from silence."""
    shares = course.shares[2::2]
    if course.repeats:
        turn = (*shares[:-1], course.shares[0])
        shares = turn * (TURNS - 1) + tuple(shares)
    envelopes = {}
    for name, tone in drive.items():
        knots = tuple(tone.phasor * share for share in shares)
        envelopes[name] = BaseEnvelope(tone.frequency, 0j, knots, COURSE_KNOT_STEP)
    return shaped(envelopes, small_table().eras)


@pytest.mark.parametrize("course", [STROKES, JUMP, LOOP], ids=["strokes", "jump", "loop"])
@pytest.mark.parametrize("frequency", [60.0, 110.0, 250.0])
def test_course_is_felt_as_on_the_plate_in_time(frequency: float, course: Course) -> None:
    """The strongest 40 ms of samples, at a target and at the loudest point of another finger."""
    table = small_table()
    drive = drive_of_two_eras(frequency)

    envelope = DriveEnvelope.of_course(course)
    gain_db, crosstalk_db = predicted_gain_and_crosstalk(envelope, drive)

    duration = course.duration * (TURNS if course.repeats else 1)
    target, quiet = accelerations(table, motion_along(course, drive), duration + 0.1, LOADS)
    strongest = felt_level(np.sqrt(2 * mean_squares(target, 0.04))).max()
    fingertip = fingertip_points(*TARGET, table.plate)
    _, amplitudes = table.amplitudes(drive, fingertip, contacts=FINGERS, loads=LOADS)
    steady = felt_level(amplitudes[0])
    expected_db = in_db(strongest / steady)
    assert gain_db == pytest.approx(expected_db, abs=0.5 if course.repeats else 0.3)
    loudest = math.sqrt(2 * mean_squares(quiet, 0.04).max())
    threshold = detection_threshold(np.array(frequency))
    assert crosstalk_db == pytest.approx(in_db(loudest / threshold), abs=0.5)


@pytest.mark.parametrize("frequency", [60.0, 110.0, 250.0])
@pytest.mark.parametrize("duration", [0.02, 0.04, 0.15])
def test_gain_of_a_duration_is_that_of_the_plate_in_time(frequency: float, duration: float) -> None:
    """RMS of samples over the duration, relative to a second later, within 0.5 dB.

    At the quiet finger, the strongest of equal duration until the pulse has rung out. A carrier of
    60 Hz has little more than a period in 20 ms, where its own phase counts: 1.5 dB.
    """
    table = small_table()
    ramp = pulse_ramp(duration)
    drive = drive_of_two_eras(frequency)

    envelope = DriveEnvelope.of_pulse(duration, ramp)
    gain_db, crosstalk_db = predicted_gain_and_crosstalk(envelope, drive)

    onset = ramped_onset(drive, table.eras, ramp=ramp)
    target, _ = accelerations(table, onset, 2.0, LOADS)
    first = felt_level(np.sqrt(mean_squares(target, duration)[0]))
    steady = felt_level(np.sqrt(mean_squares(target, 0.5)[-1]))
    tolerance = 1.5 if frequency * duration < 2 else 0.5
    assert gain_db == pytest.approx(in_db(first / steady), abs=tolerance)
    pulse = ramped_pulse(drive, table.eras, ramp=ramp, duration=duration)
    _, quiet = accelerations(table, pulse, duration + 0.2, LOADS)
    loudest = math.sqrt(2 * mean_squares(quiet, duration).max())
    threshold = detection_threshold(np.array(frequency))
    assert crosstalk_db == pytest.approx(in_db(loudest / threshold), abs=tolerance + 0.3)


def test_crosstalk_of_a_click_on_drawn_plates_adds_differences_of_energy() -> None:
    """By hand: 4 heard, and a quarter of the 9 more and the 3 less that others have; 0 at least."""
    steady = np.array([[4.0, 13.0, 1.0], [9.0, 9.0, 1.0]])

    powers = on_drawn_plates(steady, np.array([4.0, 1.0]), 0.25)

    np.testing.assert_allclose(powers, [[4.0, 6.25, 3.25], [1.0, 1.0, 0.0]])


# Answers


def test_level_of_a_click_is_felt_over_its_duration() -> None:
    """The drive is raised by what the plate lags behind along the ramp."""
    table = small_table()

    click = query(table, Placement((TARGET,)), 20.0, duration=0.04, drive_mode="phased")

    (layer,) = click.layers
    assert layer.ramp == pulse_ramp(0.04) == 0.01
    frequencies, bases = base_amplitudes(layer.excitation, table.eras)
    envelope = DriveEnvelope.of_pulse(0.04, layer.ramp)
    ringing = RingingUnderFingers(table, (TARGET,), (), envelope)
    gain = ringing.over(zip(frequencies.tolist(), bases, strict=True)).gains[0]
    points = fingertip_points(*TARGET, table.plate)
    _, amplitudes = table.amplitudes(layer.excitation, points, contacts=(TARGET,))
    steady = felt_level(amplitudes[0]) / detection_threshold(frequencies)[0]
    assert click.fingers[0].level_db_sl == pytest.approx(20.0, abs=1e-3)
    assert in_db(gain * steady) == pytest.approx(20.0, abs=0.02)


def test_ramp_is_as_long_as_the_rise_of_levels_allows() -> None:
    """An ERA that rises by 3 per second takes longer than the ramp of 10 ms, and is raised."""
    table = small_table()
    finger = Finger(TARGET, Stimulus(40.0, duration=0.04))

    free = answer(table, [finger], drive_mode="phased")
    slow = answer(table, [finger], drive_mode="phased", limits=Limits(slew=3.0))

    levels = [free.amplitudes[name] / table.full_levels[name] for name in free.amplitudes]
    assert slow.layers[0].ramp == pytest.approx(max(levels) / 3.0)
    assert slow.layers[0].ramp > 0.02
    assert slow.fingers[0].level_db_sl == pytest.approx(40.0, abs=0.1)
    assert max(slow.amplitudes.values()) > max(free.amplitudes.values())


def test_quiet_fingers_limit_the_raise_of_a_click() -> None:
    """They are 6 dB below it on 90 % of plates, or the drive is that of a continuous stimulus."""
    lowered_count = 0

    for target, *quiet in contact_sets(6, fingers=9, seed=8):
        placed = Placement((target,), tuple(quiet))
        click = query(smooth_table(), placed, 20.0, duration=0.02, drive_mode="phased")
        sensation = click.fingers[0]
        assert sensation.level_db_sl <= 20.0 + 1e-3
        if sensation.lowered_db:
            lowered_count += 1
            quiet_level = sensation.level_db_sl - sensation.promised_contrast_db
            assert quiet_level > 14.0 - 0.01, target
            assert "quiet fingers" in click.applied[-1]

    assert lowered_count > 0


@pytest.mark.long
def test_promise_over_a_click_is_kept() -> None:
    """By 90 % of 240 plates in time, of other thickness, springs, losses and drives."""
    clicks = clicks_on(smooth_table(), 12, seed=3)
    promises = np.array([click.fingers[0].promised_contrast_db for click in clicks])

    contrasts = contrasts_on_drawn_plates(smooth_table(), smooth_rig(), clicks, 20, seed=4)

    assert 0.86 <= np.mean(contrasts >= promises[:, None]) <= 0.94


@pytest.mark.long
@pytest.mark.parametrize(
    ("first", "second"),
    [
        (Stimulus(20.0, course=STROKES), None),
        (Stimulus(20.0, course=STROKES), Stimulus(14.0)),
        (Stimulus(14.0), Stimulus(20.0, course=STROKES)),
        (Stimulus(20.0, course=STROKES, modulation_hz=20.0), None),
    ],
    ids=["alone", "with a steady one", "a steady one with it", "with side bands"],
)
def test_promise_over_a_course_is_kept(first: Stimulus, second: Stimulus | None) -> None:
    """By 90 % of plates in time, with a quiet finger and with a steady content."""
    table = smooth_table()
    answers = []
    for places in contact_sets(10, fingers=2, seed=3):
        fingers = [Finger(places[0], first), Finger(places[1], second)]
        answers.append(answer(table, fingers, drive_mode="phased", min_contrast_db=-99.0))
    promises = np.array([promised.fingers[0].promised_contrast_db for promised in answers])

    contrasts = contrasts_on_drawn_plates(table, smooth_rig(), answers, 12, seed=4)

    assert 0.86 <= np.mean(contrasts >= promises[:, None]) <= 0.97
    if first.modulation_hz:
        modulated = [promised for promised in answers if promised.layers[0].side_bands]
        assert len(modulated) >= 5
