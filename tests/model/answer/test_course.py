"""Courses: what is felt of a file, against hand calculation and the plate in time."""

import math
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.promise.clicks import given
from model.answer.answer import DriveEnvelope, RingingUnderFingers, pulse_ramp
from model.answer.plan import answer, query
from model.answer.stimulus import Course, Finger, Placement, Stimulus
from model.arrays import FloatArray, Point
from model.errors import InputError
from model.finger import detection_threshold, fingertip_points, fingertip_weights
from model.transients.base_motion import BaseEnvelope, rise, shaped
from model.transients.shaping import SAMPLE_RATE, Transients
from model.vibration import Tone, base_amplitudes
from plates import contact_sets, small_table, smooth_rig, smooth_table

TARGET, QUIET, STROKE = (0.09, 0.07), (0.24, 0.17), 100e-6


def along(duration: float, shares: FloatArray) -> Course:
    """A course through shares at even times of a duration [s]."""
    times = np.linspace(0, duration, len(shares))
    return Course(tuple(times.tolist()), tuple(np.clip(shares, 0, 1).tolist()))


def rising(count: int) -> FloatArray:
    """A raised cosine of 40 ms up to 1, and on from there, at knots 5 ms apart."""
    return rise(0.005 * np.arange(count), 0.040)


def strokes() -> Course:
    """Three strokes, the second half as long as the first and the last faint, as designers draw."""
    knots = rising(161) * (1 - rise(0.005 * np.arange(161) - 0.3, 0.040))
    knots[80:100] += rising(20) * rising(20)[::-1] * 0.8
    knots[120:160] += 0.3 * rising(40) * rising(40)[::-1]
    return along(0.8, knots)


def test_strongest_moments_of_a_course() -> None:
    """By hand: of a plateau 0 dB; of a triangle of 80 ms, by the mean of its square, 5/6 to 1."""
    plateau, triangle = along(0.5, np.full(101, 0.5)), along(0.08, np.array([0.0, 1.0, 0.0]))
    assert plateau.strongest_db == pytest.approx(20 * math.log10(0.5), abs=1e-6)
    # Over 20 ms on each side of the peak the mean of (1 - t / 40 ms)² is 7/12.
    assert triangle.strongest_db == pytest.approx(10 * math.log10(7 / 12), abs=0.1)
    assert along(0.5, np.zeros(3)).strongest_db == pytest.approx(-120)


def beats(frequency: float) -> Course:
    """Beats of a frequency [Hz] that come and go along a raised cosine of 8 s."""
    times = np.linspace(0, 8.0, 1601)
    slow = (1 - np.cos(2 * np.pi * times / 8.0)) / 2
    return along(8.0, slow * (1 - np.cos(2 * np.pi * frequency * times)) / 2)


def test_a_sinusoidal_modulation_has_three_tones() -> None:
    """Each side tone has half of the amplitude of the carrier, a quarter of its power."""
    off = np.arange(-60.0, 61.0, 10.0)
    shares = DriveEnvelope.of_course(beats(20.0)).shares_at(off)
    expected = 0.25 * (np.abs(off) == 20) + (off == 0)
    assert shares / shares.max() == pytest.approx(expected, abs=0.01)


def test_next_to_a_null_little_is_felt_of_slow_changes() -> None:
    """Side bands at 2 Hz are a fifth of the way to the next tone, of whose power they cause 1/25.

    At the top of a beat the carrier has half of the amplitude, each side band a quarter.
    """
    shares = DriveEnvelope.of_course(beats(2.0)).shares_at(np.array([-10.0, 0.0, 10.0]))
    assert shares[[0, 2]] == pytest.approx(0.25**2 / 25, rel=0.1)


def jump() -> Course:
    """From 0 to 1 within 5 ms, and from there down to 0 over a second."""
    return along(1.2, np.concatenate([[0.0], np.linspace(1, 0, 200), np.zeros(40)]))


@pytest.mark.parametrize("course", [strokes(), jump()], ids=["strokes", "jump"])
@pytest.mark.parametrize("loads", [(), (2.5, 0.4)])
@pytest.mark.parametrize("frequency", [60.0, 110.0, 250.0])
def test_a_course_is_felt_as_on_the_plate_in_time(
    frequency: float, loads: tuple[float, ...], course: Course
) -> None:
    """The strongest 40 ms of samples, at a target and at the loudest point of another finger."""
    table = small_table()
    drive = {"SW": Tone(frequency, 0.2 * STROKE, 0.3), "NE": Tone(frequency, 0.1 * STROKE, -1.1)}
    ringing = RingingUnderFingers(table, (TARGET, QUIET), loads, DriveEnvelope.of_course(course))
    frequencies, bases = base_amplitudes(drive, table.eras)
    found = ringing.over(zip(frequencies.tolist(), bases, strict=True))
    envelopes = {
        name: BaseEnvelope(frequency, 0j, tuple(tone.phasor * each for each in course.shares[1:]))
        for name, tone in drive.items()
    }
    points = [fingertip_points(*at, table.plate) for at in (TARGET, QUIET)]
    plate = Transients(table.in_time_under((TARGET, QUIET), loads))
    felt = plate.acceleration(
        shaped(envelopes, table.eras), np.concatenate(points), duration=course.duration + 0.1
    )
    count = round(0.04 * SAMPLE_RATE)
    sums = np.cumsum(felt**2, axis=0)
    moments = 2 * (sums[count:] - sums[:-count]) / count
    threshold = float(detection_threshold(np.array(frequency)))
    own = (np.sqrt(moments[:, : len(points[0])]) @ fingertip_weights(*TARGET, table.plate)).max()
    _, amplitudes = table.amplitudes(drive, points[0], contacts=(TARGET, QUIET), loads=loads)
    steady = float(amplitudes[0] @ fingertip_weights(*TARGET, table.plate))
    assert 20 * math.log10(found.gains[0]) == pytest.approx(20 * math.log10(own / steady), abs=0.3)
    loudest = moments[:, len(points[0]) :].max() / threshold**2
    assert 10 * math.log10(found.heard[1].max()) == pytest.approx(10 * math.log10(loudest), abs=0.5)


def test_a_course_that_is_a_click_is_answered_as_the_click() -> None:
    """Along its raised cosines, at the level of its 40 ms and its frequency: with its contrast.

    Up to 1.5 dB more: of a click the first 40 ms count at the target, of a course the strongest.
    Of two frequencies that are nearly as good a click has the better one in time.
    """
    table, times = smooth_table(), np.linspace(0, 0.05, 51)
    ramp = pulse_ramp(0.04)
    click = along(0.05, rise(times, ramp) - rise(np.asarray(times - 0.04), ramp))
    for target, *quiet in contact_sets(6, fingers=3, seed=8):
        placed = Placement((target,), tuple(quiet))
        one = query(table, placed, 20.0, duration=0.04, drive_mode="phased")
        level, hertz = 20.0 - click.strongest_db, one.layers[0].frequency
        at = {"course": click, "band_hz": (hertz, hertz)}
        other = query(table, placed, level, **at, drive_mode="phased")
        contrasts = [each.fingers[0].promised_contrast_db or 0.0 for each in (one, other)]
        assert contrasts[0] - 0.1 <= contrasts[1] <= contrasts[0] + 1.5
        assert other.fingers[0].level_db_sl == pytest.approx(level, abs=0.01)


@pytest.mark.parametrize("quiet", [(), (QUIET,)], ids=["alone", "beside"])
def test_a_course_that_stays_faint_is_answered_as_a_strong_one(quiet: tuple[Point, ...]) -> None:
    """A fiftieth of it, 34 dB fainter, 34 dB above: all is linear, so it is the same drive."""
    table, placed = smooth_table(), Placement((TARGET,), quiet)
    found = []
    for height in (1.0, 0.02):
        course = along(1.0, np.array([0.0, height, 0.0]))
        level = -14 - 20 * math.log10(height)
        found.append(query(table, placed, level, course=course, drive_mode="phased"))
    strong, faint = found
    assert faint.layers[0].frequency == strong.layers[0].frequency
    for name, tone in strong.layers[0].excitation.items():
        other = faint.layers[0].excitation[name]
        assert abs(0.02 * other.phasor / tone.phasor - 1) < 1e-3


def test_promise_over_a_course_is_kept() -> None:
    """By nine of ten of 120 plates in time, beside a quiet finger and beside a steady content."""
    table, rig, stimulus = smooth_table(), smooth_rig(), Stimulus(20.0, course=strokes())
    steady = Stimulus(14.0)
    for has_other, first in ((False, stimulus), (True, stimulus), (True, steady)):
        answers = []
        for places in contact_sets(10, fingers=2, seed=3):
            second = (steady if first is stimulus else stimulus) if has_other else None
            fingers = [Finger(places[0], first), Finger(places[1], second)]
            answers.append(answer(table, fingers, drive_mode="phased", min_contrast_db=-99.0))
        promised = np.array([each.fingers[0].promised_contrast_db for each in answers])
        found = given(table, rig, answers, 12, seed=4)
        assert 0.86 <= np.mean(found >= promised[:, None]) <= 0.95, (has_other, first)


def test_side_bands_of_a_course_are_promised_too() -> None:
    """A texture of 20 Hz along a course: on nine of ten plates in time."""
    table, rig, answers = smooth_table(), smooth_rig(), []
    for places in contact_sets(10, fingers=2, seed=5):
        fingers = [Finger(places[0], Stimulus(20.0, course=strokes(), modulation_hz=20.0))]
        answers.append(answer(table, fingers, quiet=places[1:], drive_mode="phased"))
    assert sum(bool(each.layers[0].side_bands) for each in answers) >= 5
    promised = np.array([each.fingers[0].promised_contrast_db for each in answers])
    found = given(table, rig, answers, 30, seed=6)
    assert 0.86 <= np.mean(found >= promised[:, None]) <= 0.97


def test_a_stimulus_has_the_duration_of_its_course() -> None:
    """And no other; a course must be one."""
    course = along(0.5, np.array([0.0, 1.0, 0.0]))
    stimulus = Stimulus(20.0, course=course)
    assert stimulus.duration == 0.5
    assert replace(stimulus, level_db_sl=10.0).duration == 0.5
    with pytest.raises(InputError, match="duration must be left out of a stimulus with a course"):
        Stimulus(20.0, duration=0.2, course=course)
    with pytest.raises(InputError, match="course must be one such as"):
        Stimulus(20.0, course=(0.0, 1.0))  # type: ignore[arg-type]
