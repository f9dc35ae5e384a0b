"""Renditions: what a pattern becomes on a plate at a level, before anybody else's is known.

Its reasons are in docs/how-to/play-a-file.md.
"""

from bisect import bisect_left
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np

from controller.content.pattern import Curve, Pattern, Transient
from model.answer.course import Course
from model.answer.fingers import MAX_MODULATION, MIN_MODULATION
from model.arrays import FloatArray
from model.choice import best_of
from model.finger.perception import decibels
from model.transients.base_motion import KNOT_STEP, rise

Band: TypeAlias = tuple[float, float]
"""Lowest and highest frequency [Hz]."""

LEAST_DB_SL = 10.0
"""Level of the faintest intensity, the least that Android's builder of envelopes guarantees."""

DULLEST_HZ, SHARPEST_HZ = 65.0, 300.0
"""Frequencies of sharpness 0 and 1, as the MPEG reference encoder reads AHAP."""

CLICK_DURATION, DUCKING = 0.040, 0.030
"""Of a transient [s], and while what lasts fades before it and returns after it."""

SMOOTHING = 0.020
"""Width at half height [s] of the raised cosine over which courses beside others are averaged."""

_BAND = 0.1  # on each side of a frequency
_MIN_FREQUENCIES = 3  # of a table in a band: an exact one costs 10 dB of contrast on four ERAs
_MENTIONED = 0.05  # share of what lasts whose sharpness may be lost without a word
_ROUNDING = 1e-9  # of times [s], and of counts of steps
_DEEP = 0.5  # amplitude of a modulation to its mean that is felt as a texture


@dataclass(frozen=True)
class Click:
    """A transient: when it starts [s], its level [dB SL] and its band [Hz]."""

    time: float
    level_db_sl: float
    band: Band


@dataclass(frozen=True)
class Rendition:
    """A pattern as stimuli of one finger.

    duration [s]; course: of what lasts, ducked around the clicks, None without any; level_db_sl: at
    its highest share, 1; band [Hz]: of its carrier; modulation_hz: how often a second it comes and
    goes for most of its duration, which its course has too; clicks: ascending, apart by their
    duration and the ducking; remarks: what was changed or lost on the way, in words.
    """

    duration: float
    course: Course | None
    level_db_sl: float
    band: Band
    modulation_hz: float | None
    clicks: tuple[Click, ...]
    remarks: tuple[str, ...]

    def smoothed(self) -> "Rendition":
        """Return it as it is played where other fingers are on the plate: averaged over 20 ms.

        It starts from rest and ends at rest, 20 ms each, within its duration.
        """
        if self.course is None:
            return self
        times = np.array(self.course.times)
        shares = _averaged(np.array(self.course.shares), times[1], SMOOTHING)
        shares *= rise(times, SMOOTHING) * rise(times[-1] - times, SMOOTHING)
        course = Course(self.course.times, tuple(np.clip(shares, 0, 1).tolist()))
        return replace(self, course=course)


def level_wanted(pattern: Pattern, level_db_sl: float, times: FloatArray) -> FloatArray:
    """Levels [dB SL] that a pattern asks for at times [s] (n,), before anything of it is lost.

    level_db_sl: of intensity 1; -inf for nothing.
    """
    level, taps = _lasting(pattern, level_db_sl, times), pattern.transients
    starts = np.array([each.time for each in taps])
    first, last = np.searchsorted(times, [starts, starts + CLICK_DURATION])
    number = np.repeat(np.arange(len(taps)), last - first)
    during = np.arange(len(number)) + (last - np.cumsum(last - first))[number]
    levels = _level_of(np.array([each.intensity for each in taps]), level_db_sl)
    np.maximum.at(level, during, levels[number])
    return level


def rendered(pattern: Pattern, level_db_sl: float, frequencies: FloatArray) -> Rendition:
    """Map a pattern to stimuli of a level [dB SL] at intensity 1, on a table's frequencies [Hz].

    Intensity i is 10 + i (level - 10) dB SL, 0 is silent; sharpness is a frequency in a band of
    10 % on each side, or of the table's nearest three. What lasts has one band, where most of its
    energy is; transients are clicks, of those too close together the strongest.
    """
    taps = _apart(pattern)
    levels = _level_of(np.array([each.intensity for each in taps]), level_db_sl)
    hertz = _hertz(np.array([each.sharpness for each in taps]))
    clicks = tuple(
        Click(tap.time, level, _band(frequency, frequencies))
        for tap, level, frequency in zip(taps, levels.tolist(), hertz.tolist(), strict=True)
    )
    starts = np.array([each.time for each in clicks])
    duration = max(pattern.duration, *((starts + CLICK_DURATION).tolist()), KNOT_STEP)
    times = np.linspace(0, duration, int(np.ceil(duration / KNOT_STEP - _ROUNDING)) + 1)
    level = _lasting(pattern, level_db_sl, times)
    shares = 10 ** ((level - level.max(initial=-1e3)) / 20) * _beside(starts, times)
    remarks = list(pattern.remarks)
    if merged := sum(each.intensity > 0 for each in pattern.transients) - len(taps):
        remarks.append(
            f"{merged} of {merged + len(taps)} taps are left out, as they are less than "
            f"{1000 * (CLICK_DURATION + DUCKING):.0f} ms from a stronger one"
        )
    if not shares.any():
        return Rendition(
            duration,
            None,
            level_db_sl,
            _band(DULLEST_HZ, frequencies),
            None,
            clicks,
            tuple(remarks),
        )
    highest = float(shares.max())
    course = Course(tuple(times.tolist()), tuple((shares / highest).tolist()))
    hertz = _hertz(_along(pattern.sharpness, times))
    band = _band(_carrier(hertz, shares**2), frequencies)
    remarks += _lost(hertz, shares, band, clicks, frequencies)
    top = float(level.max()) + float(decibels(highest))
    return Rendition(
        duration, course, top, band, _modulation(times, shares), clicks, tuple(remarks)
    )


def _level_of(intensity: FloatArray, level_db_sl: float) -> FloatArray:
    """Levels [dB SL] of intensities; -inf for 0."""
    least = min(LEAST_DB_SL, level_db_sl)
    return np.where(intensity > 0, least + intensity * (level_db_sl - least), -np.inf)


def _lasting(pattern: Pattern, level_db_sl: float, times: FloatArray) -> FloatArray:
    """Levels [dB SL] of what lasts at times [s]."""
    return _level_of(_along(pattern.intensity, times, beyond=0.0), level_db_sl)


def _along(curve: Curve, times: FloatArray, *, beyond: float | None = None) -> FloatArray:
    """Values of a curve at times [s]; outside of it a value, by default that of its ends."""
    moments, values = np.array(curve or ((0.0, 0.0),)).T
    return np.asarray(np.interp(times, moments, values, left=beyond, right=beyond))


def _hertz(sharpness: FloatArray) -> FloatArray:
    """Frequencies of sharpness [Hz]."""
    return DULLEST_HZ + sharpness * (SHARPEST_HZ - DULLEST_HZ)


def _band(hertz: float, frequencies: FloatArray) -> Band:
    """A band about a frequency [Hz] that has enough frequencies of a table."""
    nearest = frequencies[np.argsort(np.abs(np.log(frequencies / hertz)))[:_MIN_FREQUENCIES]]
    return (
        min((1 - _BAND) * hertz, float(nearest.min())),
        max((1 + _BAND) * hertz, float(nearest.max())),
    )


def _apart(pattern: Pattern) -> list[Transient]:
    """The transients that are felt, ascending: the strongest first, those too close left out."""
    kept, times = list[Transient](), list[float]()
    for tap in sorted(pattern.transients, key=lambda each: -each.intensity):
        at = bisect_left(times, tap.time)
        around = times[max(at - 1, 0) : at + 1]
        apart = min((abs(tap.time - each) for each in around), default=np.inf)
        if tap.intensity > 0 and apart >= CLICK_DURATION + DUCKING - _ROUNDING:
            kept.insert(at, tap)
            times.insert(at, tap.time)
    return kept


def _beside(starts: FloatArray, times: FloatArray) -> FloatArray:
    """Share that is left of what lasts at times [s] beside clicks from starts [s] on."""
    bounded = np.concatenate([[-np.inf], starts, [np.inf]])
    number = np.searchsorted(starts, times, side="right")
    away = np.minimum(times - bounded[number] - CLICK_DURATION, bounded[number + 1] - times)
    return np.asarray(np.clip(away / DUCKING, 0, 1))


def _carrier(hertz: FloatArray, energy: FloatArray) -> float:
    """The frequency [Hz] about whose band most of the energy is: its mean there."""
    tried = np.geomspace(DULLEST_HZ, SHARPEST_HZ, 60)
    is_near = np.abs(hertz / tried[:, None] - 1) <= _BAND
    best = is_near[best_of(is_near @ energy)]
    return float(np.average(hertz[best], weights=energy[best]))


def _lost(
    hertz: FloatArray,
    shares: FloatArray,
    band: Band,
    clicks: Sequence[Click],
    frequencies: FloatArray,
) -> Iterator[str]:
    """What of what lasts is not played as the file has it."""
    away = (hertz < band[0]) | (hertz > band[1])
    if (lost := np.average(away, weights=shares**2)) > _MENTIONED:
        asked = hertz[shares > 0]
        yield (
            f"sharpness of {100 * lost:.0f} % of what lasts is lost: it is {asked.min():.0f} to "
            f"{asked.max():.0f} Hz in the file and has one frequency here, of {band[0]:.0f} to "
            f"{band[1]:.0f} Hz"
        )
    if clicks:
        yield f"what lasts pauses {1000 * DUCKING:.0f} ms before and after each of the taps"


def _modulation(times: FloatArray, shares: FloatArray) -> float | None:
    """How often a second [Hz] shares come and go for most of their duration, None if they do not.

    Slow is what is left after an average of 0.1 s, which holds nothing from 10 Hz on.
    """
    step = times[1]
    slow = _averaged(shares, step, 1 / MIN_MODULATION)
    fast = shares - slow
    depth = np.sqrt(2 * _averaged(fast**2, step, 1 / MIN_MODULATION))
    if np.count_nonzero(depth > _DEEP * slow) <= np.count_nonzero(slow > 0) / 2:
        return None
    hertz, power = np.fft.rfftfreq(len(fast), step), np.abs(np.fft.rfft(fast)) ** 2
    is_texture = (hertz >= MIN_MODULATION) & (hertz <= MAX_MODULATION)
    if power[is_texture].sum() <= power.sum() / 2:
        return None
    return float(hertz[is_texture][best_of(power[is_texture])])


def _averaged(values: FloatArray, step: float, width: float) -> FloatArray:
    """Values a step [s] apart, averaged by a raised cosine of a width [s] at half its height."""
    count = max(int(np.ceil(width / step - _ROUNDING)) - 1, 0)
    kernel = np.cos(np.pi / 2 * step / width * np.arange(-count, count + 1)) ** 2
    return np.convolve(values, kernel / kernel.sum())[count : count + len(values)]
