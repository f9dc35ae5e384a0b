"""Renditions: a pattern as stimuli of one finger at a level, independent of other fingers.

docs/how-to/play-content.md gives the reasons.
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
"""Fade time [s] of the continuous part before and after a transient."""

SMOOTHING = 0.020
"""Half-height width [s] of the raised cosine that averages envelopes with other fingers present."""

_BAND = 0.1  # on each side of a frequency
_WIDER = 2 ** (1 / 3) / (1 + _BAND)  # with other fingers: a third of an octave on each side
_MIN_FREQUENCIES = (
    3  # of the table in a band: one exact frequency costs 10 dB of contrast on four ERAs
)
_MENTIONED = 0.05  # share of the continuous part whose sharpness can be lost without a remark
_ROUNDING = 1e-9  # of times [s] and step counts
_TEXTURE = 3.0  # Hz; on each side of a modulation frequency, counted with it


@dataclass(frozen=True)
class Tap:
    """A transient: its start [s], level [dB SL] and band [Hz]."""

    time: float
    level_db_sl: float
    band: Band


@dataclass(frozen=True)
class Rendition:
    """A pattern as stimuli for one finger."""

    duration: float
    """[s]"""
    course: Course | None
    """Envelope of the continuous part, ducked around clicks; None without a continuous part."""
    level_db_sl: float
    """Level [dB SL] where the envelope is 1."""
    band: Band
    """Band of the carrier [Hz]."""
    modulation_hz: float | None
    """Modulation frequency [Hz] of the envelope, if it is most of its variation."""
    clicks: tuple[Tap, ...]
    """Ascending in time, at least 60 ms apart."""
    remarks: tuple[str, ...]
    """Changes and losses."""
    sharpness_kept: float = 1.0
    """Share of the continuous part's energy with frequencies in the band of the carrier."""

    def smoothed(self) -> "Rendition":
        """Return the rendition with other fingers present: its envelope averaged over 20 ms.

        Modulation is kept. The envelope starts and ends at zero. Bands are widened to a third of an
        octave on each side, hardly noticeable, to gain 1 dB of contrast.
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
    """Return the levels [dB SL] of a pattern at times [s] (n,), before any losses.

    level_db_sl: level of intensity 1. Transients last 40 ms each, and the continuous part fades
    around them; -inf during silence.
    """
    taps = [each for each in pattern.transients if each.intensity > 0]
    starts = np.array([each.time for each in taps])
    level = _lasting(pattern, level_db_sl, times) + decibels(_beside(starts, times))
    return _with_taps(level, taps, level_db_sl, times)


def rendered(pattern: Pattern, level_db_sl: float, frequencies: FloatArray) -> Rendition:
    """Map a pattern to stimuli; level_db_sl: level of intensity 1; frequencies: of the table [Hz].

    Intensity i is 10 + i (level - 10) dB SL, and 0 is silent. Sharpness is a frequency with a band
    of 10 % on each side, or of the table's nearest three frequencies. The continuous part has one
    band, around most of its energy. Transients become clicks; of several close ones, the strongest
    becomes a click and the others are added to the continuous part.
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
    """Return the levels [dB SL] of the continuous part at times [s]."""
    return _level_of(curve_at(pattern.intensity, times, beyond=0.0), level_db_sl)


def _with_taps(
    level: FloatArray, taps: Sequence[Transient], level_db_sl: float, times: FloatArray
) -> FloatArray:
    """Return levels [dB SL] at times [s], raised to the level of taps, 40 ms each."""
    starts = np.array([each.time for each in taps])
    levels = _level_of(np.array([each.intensity for each in taps]), level_db_sl)
    first, last = np.searchsorted(times, [starts, starts + CLICK_DURATION])
    number = np.repeat(np.arange(len(taps)), last - first)
    during = np.arange(len(number)) + (last - np.cumsum(last - first))[number]
    np.maximum.at(level, during, levels[number])
    return level


def _band(hertz: float, frequencies: FloatArray) -> Band:
    """Return a band around a frequency [Hz] with enough frequencies of a table."""
    nearest = frequencies[np.argsort(np.abs(np.log(frequencies / hertz)))[:_MIN_FREQUENCIES]]
    return (
        min((1 - _BAND) * hertz, float(nearest.min())),
        max((1 + _BAND) * hertz, float(nearest.max())),
    )


def _wider(band: Band) -> Band:
    """Return a band widened for other fingers."""
    return band[0] / _WIDER, band[1] * _WIDER


def _as_tap(pattern: Pattern) -> Pattern:
    """Convert a pattern too short for a plate to a transient; return others unchanged."""
    moments, values = np.array(pattern.intensity or ((0.0, 0.0),)).T
    sounds = np.maximum(values[1:], values[:-1]) > 0
    length = float(np.diff(moments)[sounds].sum())
    if pattern.transients or not values.any() or length >= CLICK_DURATION:
        return pattern
    start = float(moments[np.flatnonzero(values)[0]])
    sharpness = float(curve_at(pattern.sharpness, np.array([start]))[0])
    lost = f"{1000 * length:.0f} ms, too short for a plate: played as a tap"
    return replace(
        pattern,
        intensity=(),
        transients=(Transient(start, float(values.max()), sharpness),),
        remarks=(*pattern.remarks, lost),
    )


def _apart(pattern: Pattern) -> list[Transient]:
    """Return the transients that become clicks, in order: the strongest of close ones."""
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
    """Return the factor for the continuous part at times [s], ducked around click starts [s]."""
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
    """Yield a remark for each difference between the continuous part and the file.

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
    """Return the modulation frequency [Hz] of an envelope, if it is most of its variation."""
    hertz = np.fft.rfftfreq(len(shares), times[1])
    power = np.abs(np.fft.rfft(shares - shares.mean())) ** 2
    is_texture = (hertz >= MIN_MODULATION) & (hertz <= MAX_MODULATION)
    if power[is_texture].sum() <= power.sum() / 2:
        return None
    return float(hertz[is_texture][best_of(power[is_texture])])


def averaged(values: FloatArray, step: float, width: float) -> FloatArray:
    """Average values, a step [s] apart, by a raised cosine with a half-height width [s]."""
    count = max(int(np.ceil(width / step - _ROUNDING)) - 1, 0)
    kernel = np.cos(np.pi / 2 * step / width * np.arange(-count, count + 1)) ** 2
    return np.convolve(values, kernel / kernel.sum())[count : count + len(values)]
