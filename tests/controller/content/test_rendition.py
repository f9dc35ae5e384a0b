"""What a pattern becomes on a plate, by values calculated by hand."""

import math
from dataclasses import replace

import numpy as np
import pytest

from controller.content.pattern import Pattern, Transient
from controller.content.rendition import rendered, requested_level

EVERY_10_HZ = np.arange(40.0, 321.0, 10.0)
SECOND = Pattern(1.0, ((0.0, 1.0), (1.0, 1.0)), ((0.0, 0.5),))


@pytest.mark.parametrize(
    ("intensity", "level", "felt"),
    [(1.0, 20.0, 20.0), (0.5, 20.0, 15.0), (0.5, 30.0, 20.0), (0.01, 20.0, 10.1), (0.5, 4.0, 4.0)],
)
def test_intensity_is_a_level_from_10_db_sl_on(intensity: float, level: float, felt: float) -> None:
    """10 + i (level - 10) dB SL of what lasts and of taps, and never above the level itself."""
    steady = replace(SECOND, intensity=((0.0, intensity), (1.0, intensity)))
    assert rendered(steady, level, EVERY_10_HZ).level_db_sl == pytest.approx(felt)
    (tap,) = rendered(
        Pattern(0.0, (), (), (Transient(0.0, intensity, 0.5),)), level, EVERY_10_HZ
    ).clicks
    assert tap.level_db_sl == pytest.approx(felt)


def test_course_follows_levels_in_decibels_and_is_silent_at_0() -> None:
    """From intensity 1 to 0.5 of 20 dB SL are 5 dB, a share of 0.562; of 0 nothing is left."""
    pattern = Pattern(1.0, ((0.0, 1.0), (0.4, 1.0), (0.4, 0.5), (0.8, 0.5), (0.8, 0.0), (1.0, 0.0)))
    course = rendered(pattern, 20.0, EVERY_10_HZ).course
    assert course is not None
    shares = course.at(np.array([0.2, 0.6, 0.9]))
    assert shares == pytest.approx([1.0, 10 ** (-5 / 20), 0.0])


@pytest.mark.parametrize(
    ("sharpness", "spacing", "band"),
    [
        (0.0, 10.0, (58.5, 80.0)),  # 65 Hz: the nearest three are 60, 70 and 80
        (0.5, 10.0, (164.25, 200.75)),  # 182.5 Hz, of which 10 % hold three
        (0.5, 50.0, (140.0, 240.0)),  # of 40, 90, 140, 190, 240: the nearest three
        (1.0, 10.0, (270.0, 330.0)),
    ],
)
def test_sharpness_is_a_band_that_has_three_frequencies(
    sharpness: float, spacing: float, band: tuple[float, float]
) -> None:
    """65 to 300 Hz with 10 % on each side, of what lasts and of taps."""
    frequencies = np.arange(40.0, 321.0, spacing)
    tap = Transient(0.5, 1.0, sharpness)
    pattern = replace(SECOND, sharpness=((0.0, sharpness),), transients=(tap,))
    found = rendered(pattern, 20.0, frequencies)
    assert found.band == pytest.approx(band)
    assert found.clicks[0].band == pytest.approx(band)


def test_what_lasts_has_one_band_where_most_of_its_energy_is() -> None:
    """0.7 s at 206 Hz and 0.3 s at 253 Hz: the band of 206 Hz, and 30 % is said to be lost."""
    pattern = replace(SECOND, sharpness=((0.0, 0.6), (0.7, 0.6), (0.7, 0.8), (1.0, 0.8)))
    found = rendered(pattern, 20.0, EVERY_10_HZ)
    assert found.band == pytest.approx((0.9 * 206, 1.1 * 206))
    assert found.remarks == (
        "sharpness of 30 % of what lasts: 206 to 253 Hz in the file, one frequency here",
    )


def test_what_lasts_fades_for_30_ms_around_a_tap_of_40_ms() -> None:
    """Half of it 15 ms before a tap and 15 ms after its end, nothing within it."""
    pattern = replace(SECOND, transients=(Transient(0.5, 1.0, 0.5),))
    found = rendered(pattern, 20.0, EVERY_10_HZ)
    assert found.course is not None
    shares = found.course.at(np.array([0.46, 0.485, 0.5, 0.54, 0.555, 0.58]))
    assert shares == pytest.approx([1.0, 0.5, 0.0, 0.0, 0.5, 1.0])
    assert found.remarks == ("what lasts, 30 ms before and after each tap",)


def test_of_taps_closer_than_60_ms_the_strongest_stay() -> None:
    """A rising row 50 ms apart keeps every other one; what lasts has the others, where it may."""
    row = [Transient(0.05 * number, 0.2 * number, 0.0) for number in range(5)]
    found = rendered(Pattern(1.0, transients=tuple(row)), 20.0, EVERY_10_HZ)
    assert [each.time for each in found.clicks] == pytest.approx([0.1, 0.2])
    assert found.remarks[0] == (
        "2 of 4 taps, less than 60 ms from a stronger one: left to what lasts"
    )
    assert found.level_db_sl == pytest.approx(16.0)
    assert found.course is not None
    shares = found.course.at(np.array([0.07, 0.155, 0.17, 0.3]))
    assert shares == pytest.approx([10 ** (-4 / 20), 0.5, 1.0, 0.0])


def test_what_lasts_20_ms_is_a_tap() -> None:
    """It would be over before a plate follows; a tap is raised so that it is felt."""
    pattern = Pattern(0.3, ((0.0, 0.0), (0.1, 0.0), (0.1, 0.8), (0.12, 0.8), (0.12, 0.0)))
    found = rendered(pattern, 20.0, EVERY_10_HZ)
    assert found.course is None
    (tap,) = found.clicks
    assert (tap.time, tap.level_db_sl) == pytest.approx((0.1, 18.0))


def test_beside_others_bands_reach_a_third_of_an_octave() -> None:
    """From 206 Hz up to 259.5 and, from 10 % below it, by as much down to 161.9; taps alike."""
    pattern = replace(SECOND, sharpness=((0.0, 0.6),), transients=(Transient(0.5, 1.0, 0.6),))
    found = rendered(pattern, 20.0, EVERY_10_HZ).smoothed()
    assert found.band == pytest.approx((161.9, 259.5), abs=0.1)
    assert found.clicks[0].band == pytest.approx((161.9, 259.5), abs=0.1)


def test_smoothed_step_is_a_raised_cosine_of_20_ms() -> None:
    """10 ms after a step its integral is 30 of 40 ms and 20 / pi more: 0.91 of it."""
    pattern = Pattern(1.0, ((0.0, 0.0), (0.5, 0.0), (0.5, 1.0), (1.0, 1.0)))
    course = rendered(pattern, 20.0, EVERY_10_HZ).smoothed().course
    assert course is not None
    moments = np.array([0.48, 0.4975, 0.5075, 0.52, 0.9, 1.0])
    after = (30 + 20 / math.pi) / 40
    assert course.at(moments) == pytest.approx([0.0, 0.5, after, 1.0, 1.0, 0.0], abs=0.03)


@pytest.mark.parametrize(("hertz", "is_texture"), [(25.0, True), (4.0, False)])
def test_modulation_of_10_to_30_hz_is_a_texture_that_smoothing_keeps(
    hertz: float, is_texture: bool
) -> None:
    """Comes and goes 25 times a second: of that the average of 20 ms would leave the half."""
    times = np.linspace(0, 1, 401)
    wave = np.sin(2 * np.pi * hertz * times)
    levels = 20 * np.log10(0.6 + 0.4 * wave)  # to the highest
    intensity = np.clip(1 + levels / 10, 1e-6, 1)
    pattern = Pattern(1.0, tuple(zip(times.tolist(), intensity.tolist(), strict=True)))
    found = rendered(pattern, 20.0, EVERY_10_HZ)
    assert (found.modulation_hz is not None) is is_texture
    if not is_texture:
        return
    assert found.modulation_hz == pytest.approx(hertz, abs=1)
    for each in (found, found.smoothed()):
        assert each.course is not None
        middle = each.course.at(np.arange(0.2, 0.8, 0.005))
        depth = (middle.max() - middle.min()) / (middle.max() + middle.min())
        assert depth == pytest.approx((1 - 0.32) / 1.32, abs=0.1)  # not below 10 dB SL


def test_wanted_levels_are_of_all_taps_and_of_what_lasts_between() -> None:
    """Taps that are merged are wanted all the same; what lasts pauses for them, 6 dB at half."""
    taps = Transient(0.5, 1.0, 0.5), Transient(0.53, 0.5, 0.5)
    pattern = replace(SECOND, intensity=((0.0, 0.5), (1.0, 0.5)), transients=taps)
    times = np.array([0.2, 0.485, 0.5, 0.539, 0.55, 0.585, 1.2])
    levels = requested_level(pattern, 20.0, times)
    assert levels == pytest.approx([15.0, 9.0, 20.0, 20.0, 15.0, 9.0, -np.inf], abs=0.03)
