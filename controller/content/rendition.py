"""Renditions: a pattern as stimuli of one finger at a level, whatever other fingers feel.

The reasons are in docs/how-to/play-content.md.
"""

from array import array
from bisect import bisect_left
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from controller.content.pattern import MAX_HZ, MIN_HZ, Pattern, Transient, curve_at, hertz_of
from controller.play.intent import Band
from model.answer.stimulus import MAX_MODULATION, MIN_MODULATION, Course
from model.arrays import FloatArray, best_of
from model.finger import decibels
from model.quantities import percent
from model.transients.base_motion import KNOT_STEP, rise
from model.transients.excursions import CLICKS_APART

LEAST_DB_SL = 10.0
"""Level [dB SL] of the faintest intensity: the lowest that envelopes of Android guarantee."""

CLICK_DURATION = 0.040
"""Duration of a transient [s]."""

DUCKING = 0.030
"""Time [s] in which what lasts fades before a transient, and returns after it."""

SMOOTHING = 0.020
"""Width at half height [s] of the raised cosine over which courses beside others are averaged."""

_BAND = 0.1  # on each side of a frequency
_WIDER = 2 ** (1 / 3) / (1 + _BAND)  # beside others: to a third of an octave on each side
_MIN_FREQUENCIES = 3  # of a table in a band: an exact one costs 10 dB of contrast on four ERAs
_MENTIONED = 0.05  # share of what lasts whose sharpness may be lost without a word
_ROUNDING = 1e-9  # of times [s], and of counts of steps
_TEXTURE = 3.0  # Hz; on each side of a modulation, of which it is


@dataclass(frozen=True)
class Tap:
    """A transient: its start [s], level [dB SL] and band [Hz]."""

    time: float
    level_db_sl: float
    band: Band


@dataclass(frozen=True)
class Rendition:
    """A pattern as stimuli of one finger."""

    duration: float
    """[s]"""
    course: Course | None
    """Of what lasts, ducked around the clicks; None if nothing lasts."""
    level_db_sl: float
    """Where the share of the course is 1."""
    band: Band
    """Of the carrier of the course [Hz]."""
    modulation_hz: float | None
    """Frequency [Hz] at which the course comes and goes, if that is most of its change."""
    clicks: tuple[Tap, ...]
    """Ascending in time, at least 60 ms apart."""
    remarks: tuple[str, ...]
    """What was changed or lost."""
    sharpness_kept: float = 1.0
    """Share of what lasts, by its energy, whose frequency is in the band of the carrier."""

    def smoothed(self) -> "Rendition":
        """Return the rendition beside other fingers: its course averaged over 20 ms.

        Its modulation stays. The course starts and ends at rest. Bands reach a third of an octave
        to each side, which fingers hardly notice, for 1 dB of contrast.
        """
        clicks = tuple([replace(each, band=_wider(each.band)) for each in self.clicks])
        among = replace(self, band=_wider(self.band), clicks=clicks)
        if self.course is None:
            return among
        times, shares = np.array(self.course.times), np.array(self.course.shares)
        texture = np.zeros(len(times))
        if self.modulation_hz is not None:
            spectrum = np.fft.rfft(shares)
            away = np.abs(np.fft.rfftfreq(len(shares), times[1]) - self.modulation_hz)
            texture = np.fft.irfft(spectrum * (away <= _TEXTURE), len(shares))
        shares = averaged(shares - texture, times[1], SMOOTHING) + texture
        shares *= rise(times, SMOOTHING) * rise(times[-1] - times, SMOOTHING)
        course = Course(self.course.times, array("d", np.clip(shares, 0, 1)))
        return replace(among, course=course)


def requested_level(pattern: Pattern, level_db_sl: float, times: FloatArray) -> FloatArray:
    """Return the levels [dB SL] of a pattern at times [s] (n,), before anything of it is lost.

    level_db_sl: of intensity 1. Transients last 40 ms each, and what lasts fades around them; -inf
    where nothing is felt.
    """
    taps = [each for each in pattern.transients if each.intensity > 0]
    starts = np.array([each.time for each in taps])
    level = _lasting(pattern, level_db_sl, times) + decibels(_beside(starts, times))
    return _with_taps(level, taps, level_db_sl, times)


def rendered(pattern: Pattern, level_db_sl: float, frequencies: FloatArray) -> Rendition:
    """Map a pattern to stimuli of a level [dB SL] at intensity 1, on a table's frequencies [Hz].

    Intensity i is 10 + i (level - 10) dB SL, and 0 is silent; sharpness is a frequency in a band of
    10 % on each side, or of the table's nearest three. What lasts has one band, where most of its
    energy is. Transients are clicks; of those too close together the strongest is one, and the
    others are left to what lasts.
    """
    pattern = _as_tap(pattern)
    taps = _apart(pattern)
    levels = _level_of(np.array([each.intensity for each in taps]), level_db_sl)
    hertz = hertz_of(np.array([each.sharpness for each in taps]))
    clicks = tuple(
        Tap(tap.time, level, _band(frequency, frequencies))
        for tap, level, frequency in zip(taps, levels.tolist(), hertz.tolist(), strict=True)
    )
    starts = np.array([each.time for each in clicks])
    duration = max(pattern.duration, *((starts + CLICK_DURATION).tolist()), KNOT_STEP)
    times = np.linspace(0, duration, int(np.ceil(duration / KNOT_STEP - _ROUNDING)) + 1)
    level = _lasting(pattern, level_db_sl, times)
    kept = {*taps}
    close = [each for each in pattern.transients if each.intensity > 0 and each not in kept]
    level = _with_taps(level, close, level_db_sl, times)
    shares = 10 ** ((level - level.max(initial=-1e3)) / 20) * _beside(starts, times)
    remarks = list(pattern.remarks)
    if close:
        remarks.append(
            f"{len(close)} of {len(close) + len(taps)} taps, less than {1000 * CLICKS_APART:.0f} "
            "ms from a stronger one: moved into the continuous part"
        )
    course, band, modulation = None, _band(MIN_HZ, frequencies), None
    sharpness_kept = 1.0
    if highest := float(shares.max()):
        course = Course(array("d", times), array("d", shares / highest))
        of_taps = tuple((each.time, each.sharpness) for each in pattern.transients)
        hertz = hertz_of(curve_at(pattern.sharpness or of_taps, times))
        band = _band(_carrier(hertz, shares**2), frequencies)
        modulation = _modulation(times, shares)
        is_off_band = (hertz < band[0]) | (hertz > band[1])
        sharpness_kept = 1 - float(np.average(is_off_band, weights=shares**2))
        remarks += _lost(hertz[shares > 0], sharpness_kept, clicks)
        level_db_sl = float(level.max() + decibels(highest))
    return Rendition(
        duration, course, level_db_sl, band, modulation, clicks, tuple(remarks), sharpness_kept
    )


def _level_of(intensity: FloatArray, level_db_sl: float) -> FloatArray:
    """Return the levels [dB SL] of intensities; -inf for 0."""
    least = min(LEAST_DB_SL, level_db_sl)
    return np.where(intensity > 0, least + intensity * (level_db_sl - least), -np.inf)


def _lasting(pattern: Pattern, level_db_sl: float, times: FloatArray) -> FloatArray:
    """Return the levels [dB SL] of what lasts at times [s]."""
    return _level_of(curve_at(pattern.intensity, times, beyond=0.0), level_db_sl)


def _with_taps(
    level: FloatArray, taps: Sequence[Transient], level_db_sl: float, times: FloatArray
) -> FloatArray:
    """Return levels [dB SL] at times [s], or those of taps, 40 ms each, where they are higher."""
    starts = np.array([each.time for each in taps])
    levels = _level_of(np.array([each.intensity for each in taps]), level_db_sl)
    first, last = np.searchsorted(times, [starts, starts + CLICK_DURATION])
    number = np.repeat(np.arange(len(taps)), last - first)
    during = np.arange(len(number)) + (last - np.cumsum(last - first))[number]
    np.maximum.at(level, during, levels[number])
    return level


def _band(hertz: float, frequencies: FloatArray) -> Band:
    """Return a band about a frequency [Hz] that has enough frequencies of a table."""
    nearest = frequencies[np.argsort(np.abs(np.log(frequencies / hertz)))[:_MIN_FREQUENCIES]]
    return (
        min((1 - _BAND) * hertz, float(nearest.min())),
        max((1 + _BAND) * hertz, float(nearest.max())),
    )


def _wider(band: Band) -> Band:
    """Return a band as it is beside other fingers."""
    return band[0] / _WIDER, band[1] * _WIDER


def _as_tap(pattern: Pattern) -> Pattern:
    """Return a pattern too short for a plate to follow as a transient; any other as it is."""
    moments, values = np.array(pattern.intensity or ((0.0, 0.0),)).T
    sounds = np.maximum(values[1:], values[:-1]) > 0
    length = float(np.diff(moments)[sounds].sum())
    if pattern.transients or not values.any() or length >= CLICK_DURATION:
        return pattern
    start = float(moments[np.flatnonzero(values)[0]])
    sharpness = float(curve_at(pattern.sharpness, np.array([start]))[0])
    lost = f"{1000 * length:.0f} ms, less than a plate follows: played as a tap"
    return replace(
        pattern,
        intensity=(),
        transients=(Transient(start, float(values.max()), sharpness),),
        remarks=(*pattern.remarks, lost),
    )


def _apart(pattern: Pattern) -> list[Transient]:
    """Return the transients that become clicks, ascending; of those too close the strongest."""
    kept, times = list[Transient](), list[float]()
    for tap in sorted(pattern.transients, key=lambda each: -each.intensity):
        at = bisect_left(times, tap.time)
        around = times[max(at - 1, 0) : at + 1]
        apart = min((abs(tap.time - each) for each in around), default=np.inf)
        if tap.intensity > 0 and apart >= CLICKS_APART - _ROUNDING:
            kept.insert(at, tap)
            times.insert(at, tap.time)
    return kept


def _beside(starts: FloatArray, times: FloatArray) -> FloatArray:
    """Return the share left of what lasts at times [s] beside clicks from starts [s] on."""
    bounded = np.concatenate([[-np.inf], starts, [np.inf]])
    number = np.searchsorted(starts, times, side="right")
    away = np.minimum(times - bounded[number] - CLICK_DURATION, bounded[number + 1] - times)
    return np.asarray(np.clip(away / DUCKING, 0, 1))


def _carrier(hertz: FloatArray, energy: FloatArray) -> float:
    """Return the mean frequency [Hz] in the band with most of the energy."""
    order = np.argsort(hertz, kind="stable")
    ascending, below = hertz[order], np.append(0.0, np.cumsum(energy[order]))
    tried = np.geomspace(MIN_HZ, MAX_HZ, 60)
    first = np.searchsorted(ascending, (1 - _BAND) * tried)
    end = np.searchsorted(ascending, (1 + _BAND) * tried, side="right")
    best = best_of(below[end] - below[first])
    near = order[first[best] : end[best]]
    return float(np.average(hertz[near], weights=energy[near]))


def _lost(hertz: FloatArray, sharpness_kept: float, clicks: Sequence[Tap]) -> Iterator[str]:
    """Yield a remark for each way in which what lasts differs from the file.

    hertz: its frequencies [Hz] wherever it is felt.
    """
    lost = 1 - sharpness_kept
    if lost > _MENTIONED:
        yield (
            f"sharpness of {percent(lost)} of the continuous part: {hertz.min():.0f} to "
            f"{hertz.max():.0f} Hz in the file, one frequency here"
        )
    if clicks:
        yield f"the continuous part, {1000 * DUCKING:.0f} ms before and after each tap"


def _modulation(times: FloatArray, shares: FloatArray) -> float | None:
    """Return the frequency [Hz] at which shares come and go, if that is most of their change."""
    hertz = np.fft.rfftfreq(len(shares), times[1])
    power = np.abs(np.fft.rfft(shares - shares.mean())) ** 2
    is_texture = (hertz >= MIN_MODULATION) & (hertz <= MAX_MODULATION)
    if power[is_texture].sum() <= power.sum() / 2:
        return None
    return float(hertz[is_texture][best_of(power[is_texture])])


def averaged(values: FloatArray, step: float, width: float) -> FloatArray:
    """Average values a step [s] apart by a raised cosine of a width [s] at half its height."""
    count = max(int(np.ceil(width / step - _ROUNDING)) - 1, 0)
    kernel = np.cos(np.pi / 2 * step / width * np.arange(-count, count + 1)) ** 2
    return np.convolve(values, kernel / kernel.sum())[count : count + len(values)]
