"""What a pattern becomes on a plate: level, band, course and taps, calculated by hand."""

from dataclasses import replace

import numpy as np
import pytest

from controller.content.pattern import Pattern, Transient
from controller.content.rendition import rendered, requested_level

EVERY_10_HZ = np.arange(40.0, 321.0, 10.0)
SECOND = Pattern(1.0, ((0.0, 1.0), (1.0, 1.0)), ((0.0, 0.5),))
"""A second of full intensity."""


@pytest.mark.parametrize(
    ("intensity", "level", "felt"),
    [(1.0, 20.0, 20.0), (0.5, 20.0, 15.0), (0.5, 30.0, 20.0), (0.01, 20.0, 10.1), (0.5, 4.0, 4.0)],
)
def test_rendition_level_rises_with_intensity_from_10_db_sl(
    intensity: float, level: float, felt: float
) -> None:
    """10 + intensity x (level - 10) dB SL, continuous and for taps, and never above the level."""
    continuous = replace(SECOND, intensity=((0.0, intensity), (1.0, intensity)))
    tap = Pattern(0.0, transients=(Transient(0.0, intensity, 0.5),))

    assert rendered(continuous, level, EVERY_10_HZ).level_db_sl == pytest.approx(felt)
    (click,) = rendered(tap, level, EVERY_10_HZ).clicks
    assert click.level_db_sl == pytest.approx(felt)


def test_rendition_course_follows_levels_in_decibels() -> None:
    """At 20 dB SL, intensity 0.5 is 5 dB less than 1, a share of 0.562; 0 is silent."""
    intensity = ((0.0, 1.0), (0.4, 1.0), (0.4, 0.5), (0.8, 0.5), (0.8, 0.0), (1.0, 0.0))

    course = rendered(Pattern(1.0, intensity), 20.0, EVERY_10_HZ).course

    shares = course.at(np.array([0.2, 0.6, 0.9]))
    assert shares == pytest.approx([1.0, 10 ** (-5 / 20), 0.0])


@pytest.mark.parametrize(
    ("sharpness", "spacing", "band"),
    [
        (0.0, 10.0, (58.5, 80.0)),  # 65 Hz: the nearest three are 60, 70 and 80 Hz
        (0.5, 10.0, (164.25, 200.75)),  # 182.5 Hz: three are within 10 %
        (0.5, 50.0, (140.0, 240.0)),  # the nearest three of 40, 90, 140, 190 and 240 Hz
        (1.0, 10.0, (270.0, 330.0)),
    ],
)
def test_rendition_band_of_a_sharpness_includes_three_frequencies(
    sharpness: float, spacing: float, band: tuple[float, float]
) -> None:
    """Sharpness 0 to 1 is 65 to 300 Hz; the band has 10 % on each side, for taps as well."""
    frequencies = np.arange(40.0, 321.0, spacing)
    tap = Transient(0.5, 1.0, sharpness)
    pattern = replace(SECOND, sharpness=((0.0, sharpness),), transients=(tap,))

    rendition = rendered(pattern, 20.0, frequencies)

    assert rendition.band == pytest.approx(band)
    assert rendition.clicks[0].band == pytest.approx(band)


def test_rendition_has_the_band_with_most_of_the_energy() -> None:
    """0.7 s at 206 Hz and 0.3 s at 253 Hz: 30 % of it is reported as lost."""
    pattern = replace(SECOND, sharpness=((0.0, 0.6), (0.7, 0.6), (0.7, 0.8), (1.0, 0.8)))

    rendition = rendered(pattern, 20.0, EVERY_10_HZ)

    assert rendition.band == pytest.approx((0.9 * 206, 1.1 * 206))
    assert rendition.remarks == (
        "sharpness of 30 % of the continuous part: 206 to 253 Hz in the file, one frequency here",
    )


def test_rendition_fades_the_continuous_part_for_30_ms_around_a_tap() -> None:
    """A tap takes 40 ms: half of the amplitude 15 ms before and after it, nothing within it."""
    pattern = replace(SECOND, transients=(Transient(0.5, 1.0, 0.5),))

    rendition = rendered(pattern, 20.0, EVERY_10_HZ)

    shares = rendition.course.at(np.array([0.46, 0.485, 0.5, 0.54, 0.555, 0.58]))
    assert shares == pytest.approx([1.0, 0.5, 0.0, 0.0, 0.5, 1.0])
    assert rendition.remarks == ("the continuous part, 30 ms before and after each tap",)


def test_rendition_keeps_the_strongest_of_taps_closer_than_60_ms() -> None:
    """Of taps 50 ms apart with rising intensity every other one stays.

    The continuous part has the others, where it does not pause for a tap.
    """
    taps = [Transient(0.05 * number, 0.2 * number, 0.0) for number in range(5)]

    rendition = rendered(Pattern(1.0, transients=tuple(taps)), 20.0, EVERY_10_HZ)

    assert [click.time for click in rendition.clicks] == pytest.approx([0.1, 0.2])
    assert rendition.remarks[0] == (
        "2 of 4 taps, less than 60 ms from a stronger one: moved into the continuous part"
    )
    assert rendition.level_db_sl == pytest.approx(16.0)
    shares = rendition.course.at(np.array([0.07, 0.155, 0.17, 0.3]))
    assert shares == pytest.approx([10 ** (-4 / 20), 0.5, 1.0, 0.0])


def test_rendition_plays_a_continuous_part_of_20_ms_as_a_tap() -> None:
    """It would be over before the plate follows, whereas a tap is shaped so that it is felt."""
    pattern = Pattern(0.3, ((0.0, 0.0), (0.1, 0.0), (0.1, 0.8), (0.12, 0.8), (0.12, 0.0)))

    rendition = rendered(pattern, 20.0, EVERY_10_HZ)

    assert rendition.course is None
    (click,) = rendition.clicks
    assert click.time == pytest.approx(0.1)
    assert click.level_db_sl == pytest.approx(18.0)


def test_smoothed_rendition_has_bands_of_a_third_of_an_octave_on_each_side() -> None:
    """From 206 Hz up to 259.5 Hz, and from 10 % below it down to 161.9 Hz; for taps as well."""
    pattern = replace(SECOND, sharpness=((0.0, 0.6),), transients=(Transient(0.5, 1.0, 0.6),))

    rendition = rendered(pattern, 20.0, EVERY_10_HZ).smoothed()

    assert rendition.band == pytest.approx((161.9, 259.5), abs=0.1)
    assert rendition.clicks[0].band == pytest.approx((161.9, 259.5), abs=0.1)


def modulated_pattern(frequency: float) -> Pattern:
    """Return a second at 20 dB SL whose amplitude varies from 0.2 to 1 of the highest."""
    times = np.linspace(0, 1, 401)
    amplitude = 0.6 + 0.4 * np.sin(2 * np.pi * frequency * times)
    intensity = np.clip(1 + 20 * np.log10(amplitude) / 10, 1e-6, 1)
    return Pattern(1.0, tuple(zip(times.tolist(), intensity.tolist(), strict=True)))


def test_rendition_keeps_a_modulation_of_10_to_30_hz_when_it_is_smoothed() -> None:
    """An average over 20 ms would halve a modulation of 25 Hz.

    No level is below 10 dB SL, so the amplitude varies from 0.32 to 1 of the highest.
    """
    rendition = rendered(modulated_pattern(25.0), 20.0, EVERY_10_HZ)

    assert rendition.modulation_hz == pytest.approx(25.0, abs=1)
    for course in (rendition.course, rendition.smoothed().course):
        amplitude = course.at(np.arange(0.2, 0.8, 0.005))
        depth = (amplitude.max() - amplitude.min()) / (amplitude.max() + amplitude.min())
        assert depth == pytest.approx((1 - 0.32) / 1.32, abs=0.1)


def test_rendition_treats_a_modulation_below_10_hz_as_a_course() -> None:
    """A modulation of 4 Hz is slow enough to be smoothed."""
    assert rendered(modulated_pattern(4.0), 20.0, EVERY_10_HZ).modulation_hz is None


def test_requested_level_includes_all_taps_and_the_continuous_part_between_them() -> None:
    """Taps that are merged count; the continuous part pauses for them, 6 dB down at half."""
    taps = (Transient(0.5, 1.0, 0.5), Transient(0.53, 0.5, 0.5))
    pattern = replace(SECOND, intensity=((0.0, 0.5), (1.0, 0.5)), transients=taps)

    levels = requested_level(pattern, 20.0, np.array([0.2, 0.485, 0.5, 0.539, 0.55, 0.585, 1.2]))

    assert levels == pytest.approx([15.0, 9.0, 20.0, 20.0, 15.0, 9.0, -np.inf], abs=0.03)
