"""Measures of sensor signals: tones, spectrum, contrast and reverberation time."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from model.arrays import ComplexArray, FloatArray
from model.errors import InputError
from model.finger.contrast import contrast_db
from model.transients.measures import ONSET_WINDOW
from sim.plant.felt import fit_tones
from sim.sensors.recording import Recording

# T60 is fitted from -5 dB, as in ISO 3382-1, down to the noise: at least -25 dB, at most -45 dB.
_DECAY_FROM, _DECAY_TO, _DECAY_DEEPEST = -5.0, -25.0, -45.0
_ABOVE_NOISE = 10.0  # dB
_FLOOR_SHARE = 0.1  # of the recording, at its end, taken as noise


@dataclass(frozen=True, eq=False)
class Spectrum:
    """Peak amplitude (f, s) [m/s²] by frequency (f,) [Hz]."""

    frequencies: FloatArray
    amplitude: FloatArray


def tone_phasors(recording: Recording, frequencies: Sequence[float]) -> ComplexArray:
    """Complex amplitude (f, s) [m/s²] of tones, Im[a exp(i omega t)], t on the plate's clock.

    Least squares of all tones and a constant; the recording must be longer than the inverse of the
    smallest frequency difference. Raises InputError for fewer samples than unknowns.
    """
    count = len(frequencies)
    if len(recording.samples) < 2 * count + 1:
        raise InputError(
            f"{count} tones need {2 * count + 1} samples, got {len(recording.samples)}: "
            "record longer"
        )
    return fit_tones(recording.times, recording.samples, frequencies, with_offset=True)


def spectrum(recording: Recording) -> Spectrum:
    """Amplitude spectrum with a Hann window; tones between bins are at most 15 % low."""
    count = len(recording.samples)
    if count < 4:
        raise InputError(f"a spectrum needs at least 4 samples, got {count}; record longer")
    window = np.hanning(count + 1)[:-1]
    level = recording.samples - recording.samples.mean(axis=0)
    lines = np.fft.rfft(level * window[:, None], axis=0)
    frequencies = np.asarray(np.fft.rfftfreq(count, 1 / recording.sample_rate))
    return Spectrum(frequencies, np.asarray(2 * np.abs(lines) / window.sum(), dtype=float))


def steady_contrast_db(
    recording: Recording,
    frequencies: Sequence[float],
    *,
    target: Sequence[str],
    quiet: Sequence[str],
) -> float:
    """Contrast [dB] of steady tones: mean over the target's sensors to the loudest quiet one.

    Magnitudes of different frequencies add (paper Eq. 28). The recording must leave transients out.
    """
    peak = np.abs(tone_phasors(recording, frequencies)).sum(axis=0)
    return _contrast(recording, peak, target, quiet)


def transient_contrast_db(
    recording: Recording, *, onset: float, target: Sequence[str], quiet: Sequence[str]
) -> float:
    """Contrast [dB] of the peaks in the first 100 ms after an onset [s]."""
    peak = np.abs(recording.during(onset, onset + ONSET_WINDOW).samples).max(axis=0)
    return _contrast(recording, peak, target, quiet)


def reverberation_time(recording: Recording, *, end: float) -> float:
    """T60 [s]: time in which the vibration falls by 60 dB after the drive ends at end [s].

    Schroeder's backward integral of the squared signals, summed over the sensors, with the noise of
    its last tenth subtracted; a line fitted to its level from -5 dB to 10 dB above the noise.
    Raises InputError where the level falls by less than 25 dB before noise or the end.
    """
    power = (recording.during(end, math.inf).samples ** 2).sum(axis=1)
    floor = power[-max(int(_FLOOR_SHARE * len(power)), 1) :].mean()
    # Only up to where the decay meets the noise.
    width = max(len(power) // 200, 1)
    smooth = np.convolve(power, np.ones(width) / width, mode="same")
    last = int(np.argmax(smooth <= 2 * floor)) or len(power)
    left = np.cumsum((power[:last] - floor)[::-1])[::-1]
    level = 10 * np.log10(np.maximum(left / left[0], 1e-30)) if left[0] > 0 else np.zeros(1)
    range_db = 10 * math.log10(max(smooth.max() / max(floor, 1e-300), 1.0))
    deepest = max(_DECAY_DEEPEST, _ABOVE_NOISE - range_db)
    inside = (level <= _DECAY_FROM) & (level >= deepest)
    if deepest > _DECAY_TO or inside.sum() < 3:
        raise InputError(
            f"decay after {end:g} s must span {_ABOVE_NOISE - _DECAY_TO:g} dB, got "
            f"{range_db:.0f} dB; record longer, or drive the plate harder"
        )
    times = np.arange(len(level))[inside] / recording.sample_rate
    slope = np.polyfit(times, level[inside], 1)[0]
    return float(-60 / slope)


def _contrast(
    recording: Recording, peak: FloatArray, target: Sequence[str], quiet: Sequence[str]
) -> float:
    peak = np.maximum(peak, 1e-30)
    felt, others = peak[_columns(recording, target)], peak[_columns(recording, quiet)]
    return float(contrast_db([felt], others))


def _columns(recording: Recording, names: Sequence[str]) -> list[int]:
    unknown = [name for name in names if name not in recording.names]
    if unknown or not names:
        raise InputError(
            f"sensor must be one of {', '.join(recording.names)}, got {unknown[0]!r}"
            if unknown
            else "target and quiet must name at least one sensor each"
        )
    return [recording.names.index(name) for name in names]
