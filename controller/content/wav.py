"""WAV files: level and centre frequency of a signal over time.

A signal is felt by the strength of its vibration, not by its waveform: it is split into two bands,
below and above 140 Hz; intensity is the amplitude of both together, 1 for a sine of full scale, and
the sharpness is that of the stronger. What lies outside the frequencies that a sharpness can stand
for is left out, and said in dB.
"""

import math
from typing import Any

import numpy as np

from controller.content.format import ContentFormat, refusal, too_much
from controller.content.mixing import thinned
from controller.content.pattern import Curve, Pattern
from controller.content.sharpness import MAX_HZ, MIN_HZ, sharpness_of
from model.arrays import FloatArray
from model.errors import InputError
from model.files.wav_file import samples_of

_RATE = 200  # points a second, or a little more
_PER_POINT = 10  # samples of the analytic signal
_SPLIT = (110.0, 178.0)  # Hz; half an octave on both sides of the split fades over
_OUTER_LOW, _OUTER_HIGH = (45.0, MIN_HZ), (MAX_HZ, 430.0)  # Hz; faded out beyond
_FLOOR = 0.03  # of the highest intensity; what rings beside a burst in the bands lies below
_MIN_RATE, _MAX_RATE = 1000, 192_000
_MIN_LOST = 0.01  # of the energy


class Wav(ContentFormat):
    """Sampled signals, as PCM or float."""

    ending = "wav"
    has_channels = True

    def read(self, content: bytes, source: str, channel: int) -> Pattern:
        """Return the course of one channel's vibration."""
        rate, samples = _samples(content, source)
        count = samples.shape[1]
        if count > 2:
            raise refusal(source, f"must have 1 or 2 channels, got {count}")
        if channel > count:
            raise refusal(source, f"channel must be 1 to {count}, got {channel}")
        signal = samples[:, channel - 1]
        intensity, sharpness, remarks = course_of(signal, rate)
        if count == 2:
            remarks = (f"channel {channel} of 2 read", *remarks)
        return Pattern(len(signal) / rate, intensity, sharpness, (), remarks)


def _samples(content: bytes, source: str) -> tuple[int, FloatArray]:
    """Return the rate [Hz], and samples (n, channels) of which 1 is full scale."""
    try:
        rate, samples = samples_of(content)
    except InputError as error:
        raise refusal(source, str(error)) from error
    if not _MIN_RATE <= rate <= _MAX_RATE:
        raise refusal(source, f"sample rate must be {_MIN_RATE} to {_MAX_RATE} Hz, got {rate}")
    if problem := too_much(len(samples) / rate, 0):
        raise refusal(source, problem)
    return rate, samples


def course_of(signal: FloatArray, rate: int) -> tuple[Curve, Curve, tuple[str, ...]]:
    """Return intensity and sharpness of a signal at a rate [Hz], and what is left out."""
    import scipy.fft

    duration = len(signal) / rate
    # A second longer at least: its end does not come round to its beginning.
    length = scipy.fft.next_fast_len(len(signal) + rate, real=True)
    cycle = length / rate  # s
    spectrum = scipy.fft.rfft(signal, length)[1:] / length
    frequencies = np.arange(1, math.ceil(_OUTER_HIGH[1] * cycle)) / cycle
    outer = _rise(frequencies, *_OUTER_LOW) * _rise(1 / frequencies, *_inverse(_OUTER_HIGH))
    upper = _rise(frequencies, *_SPLIT)
    lower = _rise(1 / frequencies, *_inverse(_SPLIT))
    points = scipy.fft.next_fast_len(math.ceil(cycle * _RATE))
    step = cycle / points
    count = math.ceil(duration / step)
    levels, centres = zip(
        *(
            _band(spectrum[: len(outer)] * outer * band, points, step, count)
            for band in (lower, upper)
        ),
        strict=True,
    )
    intensity = np.hypot(*levels)
    intensity[intensity < _FLOOR * intensity.max()] = 0
    sharpness = sharpness_of(np.where(levels[1] > levels[0], *centres[::-1]))
    times = (np.arange(count) + 0.5) * step
    times[-1] = min(times[-1], duration)
    is_felt = intensity > 0
    given = np.concatenate([[0], times, [duration]])
    course = np.concatenate([intensity[:1], np.minimum(intensity, 1), intensity[-1:]]).clip(0, 1)
    return (
        thinned(given, course),
        thinned(times[is_felt], sharpness[is_felt]),
        _remarks(spectrum, outer, intensity),
    )


def _remarks(spectrum: Any, outer: FloatArray, intensity: FloatArray) -> tuple[str, ...]:
    power = abs(spectrum) ** 2
    total = float(power.sum())
    lost = 1 - float((power[: len(outer)] * outer**2).sum()) / total if total else 0.0
    remarks = []
    if lost > _MIN_LOST:
        remarks.append(
            f"{lost:.0%} of its energy ({10 * math.log10(lost):.1f} dB) lies outside "
            f"{MIN_HZ:g} to {MAX_HZ:g} Hz and is left out"
        )
    if (intensity > 1).any():
        remarks.append(f"{(intensity > 1).mean():.1%} of the time above full scale, clamped")
    return tuple(remarks)


def _band(spectrum: Any, points: int, step: float, count: int) -> tuple[FloatArray, FloatArray]:
    """Return the amplitude and the centre frequency [Hz] of a band at the first points.

    points: of the whole cycle, a step [s] apart.
    """
    bins = np.zeros(points * _PER_POINT, complex)
    bins[1 : len(spectrum) + 1] = 2 * spectrum
    analytic = np.fft.ifft(bins, norm="forward")
    power = (abs(analytic) ** 2).reshape(-1, _PER_POINT).mean(axis=1)
    turned = (np.roll(analytic, -1) * analytic.conj()).reshape(-1, _PER_POINT).sum(axis=1)
    return np.sqrt(power[:count]), np.angle(turned[:count]) * _PER_POINT / (2 * math.pi * step)


def _rise(frequencies: FloatArray, low: float, high: float) -> FloatArray:
    """Return 0 below and 1 above two frequencies; rises and falls between add as powers to 1."""
    share = np.log(frequencies / low) / math.log(high / low)
    return np.asarray(np.sin(share.clip(0, 1) * math.pi / 2))


def _inverse(edges: tuple[float, float]) -> tuple[float, float]:
    return 1 / edges[1], 1 / edges[0]
