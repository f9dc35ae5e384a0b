"""Renditions: a pattern as stimuli for one finger at a level, independent of other fingers.

docs/how-to/play-content.md gives the reasons.
"""

from array import array
from bisect import bisect_left
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from operator import attrgetter

import numpy as np

from controller.content.pattern import MAX_HZ, MIN_HZ, Pattern, Transient, curve_at, hertz_of
from controller.play.intent import Band
from model.answer.envelope import Course
from model.answer.stimulus import MAX_MODULATION, MIN_MODULATION
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
# Frequencies of the table in a band; one exact frequency costs 10 dB of contrast on four ERAs.
_MIN_FREQUENCIES = 3
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
        clicks = tuple([replace(click, band=_wider(click.band)) for click in self.clicks])
        smoothed = replace(self, band=_wider(self.band), clicks=clicks)
        if self.course is None:
            return smoothed
        times = np.array(self.course.times)
        shares = np.array(self.course.shares)
        step = times[1]
        texture = np.zeros(len(times))
        if self.modulation_hz is not None:
            texture = _texture(shares, step, self.modulation_hz)
        shares = averaged(shares - texture, step, SMOOTHING) + texture
        shares *= rise(times, SMOOTHING) * rise(times[-1] - times, SMOOTHING)
        course = replace(self.course, shares=array("d", np.clip(shares, 0, 1)))
        return replace(smoothed, course=course)

    def looped(self) -> "Rendition":
        """Return the rendition of a file that repeats."""
        if self.course is None:
            return self
        return replace(self, course=replace(self.course, repeats=True))


def requested_level(pattern: Pattern, level_db_sl: float, times: FloatArray) -> FloatArray:
    """Return the levels [dB SL] of a pattern at times [s] (n,), before any losses.

    level_db_sl: level of intensity 1. Transients last 40 ms each, and the continuous part fades
    around them; -inf during silence.
    """
    transients = [transient for transient in pattern.transients if transient.intensity > 0]
    starts = np.array([transient.time for transient in transients])
    level = _continuous_level(pattern, level_db_sl, times) + decibels(_ducking(starts, times))
    _raise_to_transients(level, transients, level_db_sl, times)
    return level


def rendered(pattern: Pattern, level_db_sl: float, frequencies: FloatArray) -> Rendition:
    """Map a pattern to stimuli; level_db_sl: level of intensity 1; frequencies: of the table [Hz].

    Intensity i is 10 + i (level - 10) dB SL, and 0 is silent. Sharpness is a frequency with a band
    of 10 % on each side, or of the table's nearest three frequencies. The continuous part has one
    band, around most of its energy. Transients become clicks; of several close ones, the strongest
    becomes a click and the others are added to the continuous part.
    """
    pattern = _as_tap(pattern)
    separate, close = _separated(pattern.transients)
    clicks = _clicks(separate, level_db_sl, frequencies)
    click_starts = np.array([click.time for click in clicks])
    click_ends = click_starts + CLICK_DURATION
    duration = max(pattern.duration, *click_ends.tolist(), KNOT_STEP)
    times = _knots(duration)
    level = _continuous_level(pattern, level_db_sl, times)
    _raise_to_transients(level, close, level_db_sl, times)
    shares = 10 ** ((level - level.max(initial=-1e3)) / 20) * _ducking(click_starts, times)
    remarks = list(pattern.remarks)
    if close:
        count = len(close) + len(separate)
        remarks.append(
            f"{len(close)} of {count} taps, less than {1000 * CLICKS_APART:.0f} "
            "ms from a stronger one: moved into the continuous part"
        )
    highest = float(shares.max())
    if not highest:
        band = _band(MIN_HZ, frequencies)
        return Rendition(duration, None, level_db_sl, band, None, clicks, tuple(remarks))
    hertz = _hertz(pattern, times)
    energy = shares**2
    band = _band(_carrier(hertz, energy), frequencies)
    is_off_band = (hertz < band[0]) | (hertz > band[1])
    sharpness_kept = 1 - float(np.average(is_off_band, weights=energy))
    remarks += _continuous_losses(hertz[shares > 0], sharpness_kept, clicks)
    return Rendition(
        duration,
        Course(array("d", times), array("d", shares / highest)),
        float(level.max() + decibels(highest)),
        band,
        _modulation(times, shares),
        clicks,
        tuple(remarks),
        sharpness_kept,
    )


def _as_tap(pattern: Pattern) -> Pattern:
    """Convert a pattern too short for a plate to a transient; return others unchanged."""
    if pattern.transients or not pattern.intensity:
        return pattern
    times, intensities = np.array(pattern.intensity).T
    is_felt = np.maximum(intensities[1:], intensities[:-1]) > 0
    length = float(np.diff(times)[is_felt].sum())
    if not intensities.any() or length >= CLICK_DURATION:
        return pattern
    start = times[np.flatnonzero(intensities)[:1]]
    sharpness = float(curve_at(pattern.sharpness, start)[0])
    transient = Transient(float(start[0]), float(intensities.max()), sharpness)
    remark = f"{1000 * length:.0f} ms, too short for a plate: played as a tap"
    remarks = (*pattern.remarks, remark)
    return replace(pattern, intensity=(), transients=(transient,), remarks=remarks)


def _separated(
    transients: Sequence[Transient],
) -> tuple[list[Transient], list[Transient]]:
    """Return the transients that become clicks, and those too close to a stronger one, in order."""
    separate: list[Transient] = []
    times: list[float] = []
    for transient in sorted(transients, key=attrgetter("intensity"), reverse=True):
        time = transient.time
        index = bisect_left(times, time)
        neighbors = times[max(index - 1, 0) : index + 1]
        is_close = any(abs(time - near) < CLICKS_APART - _ROUNDING for near in neighbors)
        if transient.intensity > 0 and not is_close:
            separate.insert(index, transient)
            times.insert(index, time)
    clicks = {*separate}
    return separate, [tap for tap in transients if tap.intensity > 0 and tap not in clicks]


def _clicks(
    transients: Sequence[Transient], level_db_sl: float, frequencies: FloatArray
) -> tuple[Tap, ...]:
    """Return the clicks of transients; level_db_sl: level of intensity 1."""
    levels = _levels_of(transients, level_db_sl).tolist()
    centers = hertz_of(np.array([transient.sharpness for transient in transients])).tolist()
    clicks = []
    for transient, level, hertz in zip(transients, levels, centers, strict=True):
        clicks.append(Tap(transient.time, level, _band(hertz, frequencies)))
    return tuple(clicks)


def _knots(duration: float) -> FloatArray:
    """Return equally spaced times [s] from 0 to a duration, at most a knot step apart."""
    steps = int(np.ceil(duration / KNOT_STEP - _ROUNDING))
    return np.linspace(0, duration, steps + 1)


def _level_of(intensity: FloatArray, level_db_sl: float) -> FloatArray:
    """Return the levels [dB SL] of intensities; -inf for 0."""
    faintest = min(LEAST_DB_SL, level_db_sl)
    level = faintest + intensity * (level_db_sl - faintest)
    return np.where(intensity > 0, level, -np.inf)


def _levels_of(transients: Sequence[Transient], level_db_sl: float) -> FloatArray:
    """Return the levels [dB SL] of transients; level_db_sl: level of intensity 1."""
    return _level_of(np.array([transient.intensity for transient in transients]), level_db_sl)


def _continuous_level(pattern: Pattern, level_db_sl: float, times: FloatArray) -> FloatArray:
    """Return the levels [dB SL] of the continuous part at times [s]."""
    return _level_of(curve_at(pattern.intensity, times, beyond=0.0), level_db_sl)


def _raise_to_transients(
    level: FloatArray, transients: Sequence[Transient], level_db_sl: float, times: FloatArray
) -> None:
    """Raise levels [dB SL] at times [s] to the levels of transients, 40 ms each."""
    starts = np.array([transient.time for transient in transients])
    first, end = np.searchsorted(times, [starts, starts + CLICK_DURATION])
    counts = end - first
    number = np.repeat(np.arange(len(transients)), counts)
    first_entry = np.cumsum(counts) - counts
    index = np.arange(len(number)) + (first - first_entry)[number]
    np.maximum.at(level, index, _levels_of(transients, level_db_sl)[number])


def _ducking(starts: FloatArray, times: FloatArray) -> FloatArray:
    """Return the factor for the continuous part at times [s], ducked around click starts [s]."""
    bounded = np.concatenate([[-np.inf], starts, [np.inf]])
    number = np.searchsorted(starts, times, side="right")
    since_last = times - bounded[number] - CLICK_DURATION
    until_next = bounded[number + 1] - times
    distance = np.minimum(since_last, until_next)
    return np.asarray(np.clip(distance / DUCKING, 0, 1))


def _hertz(pattern: Pattern, times: FloatArray) -> FloatArray:
    """Return the frequencies [Hz] of the continuous part at times [s].

    A pattern without a sharpness curve has the sharpness of its transients.
    """
    sharpness = pattern.sharpness
    if not sharpness:
        sharpness = [(transient.time, transient.sharpness) for transient in pattern.transients]
    return hertz_of(curve_at(sharpness, times))


def _band(hertz: float, frequencies: FloatArray) -> Band:
    """Return a band around a frequency [Hz] with enough frequencies of a table."""
    distances = np.abs(np.log(frequencies / hertz))
    nearest = frequencies[np.argsort(distances)[:_MIN_FREQUENCIES]]
    low = min((1 - _BAND) * hertz, float(nearest.min()))
    high = max((1 + _BAND) * hertz, float(nearest.max()))
    return low, high


def _wider(band: Band) -> Band:
    """Return a band widened for other fingers."""
    low, high = band
    return low / _WIDER, high * _WIDER


def _carrier(hertz: FloatArray, energy: FloatArray) -> float:
    """Return the mean frequency [Hz] in the band with most of the energy."""
    order = np.argsort(hertz, kind="stable")
    ascending = hertz[order]
    energy_below = np.append(0.0, np.cumsum(energy[order]))
    centers = np.geomspace(MIN_HZ, MAX_HZ, 60)
    first = np.searchsorted(ascending, (1 - _BAND) * centers)
    end = np.searchsorted(ascending, (1 + _BAND) * centers, side="right")
    best = best_of(energy_below[end] - energy_below[first])
    in_band = order[first[best] : end[best]]
    return float(np.average(hertz[in_band], weights=energy[in_band]))


def _continuous_losses(
    hertz: FloatArray, sharpness_kept: float, clicks: Sequence[Tap]
) -> Iterator[str]:
    """Yield a remark for each difference between the continuous part and the file.

    hertz: frequencies [Hz] of the continuous part while it is felt.
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
    is_modulation = (hertz >= MIN_MODULATION) & (hertz <= MAX_MODULATION)
    modulation_power = power[is_modulation]
    if modulation_power.sum() <= power.sum() / 2:
        return None
    return float(hertz[is_modulation][best_of(modulation_power)])


def _texture(shares: FloatArray, step: float, modulation_hz: float) -> FloatArray:
    """Return the part of an envelope, a step [s] apart, around its modulation frequency."""
    spectrum = np.fft.rfft(shares)
    distances = np.abs(np.fft.rfftfreq(len(shares), step) - modulation_hz)
    return np.fft.irfft(spectrum * (distances <= _TEXTURE), len(shares))


def averaged(values: FloatArray, step: float, width: float) -> FloatArray:
    """Average values, a step [s] apart, by a raised cosine with a half-height width [s]."""
    count = max(int(np.ceil(width / step - _ROUNDING)) - 1, 0)
    phases = np.pi / 2 * step / width * np.arange(-count, count + 1)
    kernel = np.cos(phases) ** 2
    return np.convolve(values, kernel / kernel.sum())[count : count + len(values)]
