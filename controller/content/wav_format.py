"""WAV files: a sampled signal as intensity and sharpness.

A finger feels the strength of a vibration, not its waveform. The signal is split into two bands,
below and above 140 Hz. Intensity is the total amplitude of both bands, 1 for a full-scale sine; the
stronger band determines the sharpness. Components outside the frequency range of sharpness are left
out, with a remark in dB.
"""

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from controller.content.mixing import thinned_curve
from controller.content.pattern import MAX_HZ, MIN_HZ, Curve, Pattern, sharpness_of
from controller.content.reading import ContentFormat, refusal, too_much
from model.arrays import FloatArray
from model.errors import InputError
from model.files.wav_file import samples_of
from model.quantities import percent

_POINT_RATE = 200  # Hz; minimum rate of points
_PER_POINT = 10  # samples of the analytic signal
_SPLIT = (110.0, 178.0)  # Hz; half an octave on both sides of the split fades over
_LOW_EDGE = (45.0, MIN_HZ)  # Hz; faded out below
_HIGH_EDGE = (MAX_HZ, 430.0)  # Hz; faded out above
_FLOOR = 0.03  # of the highest intensity; ringing of the band filters around a burst is below
_MIN_SAMPLE_RATE, _MAX_SAMPLE_RATE = 1000, 192_000
_MIN_LOST = 0.01  # of the energy


class Wav(ContentFormat):
    """Sampled signals, as PCM or float."""

    ending = "wav"
    has_channels = True

    def read(self, content: bytes, source: str, channel: int) -> Pattern:
        """Return the pattern of one channel."""
        try:
            rate, samples = samples_of(content)
        except InputError as error:
            raise refusal(source, str(error)) from error
        if not _MIN_SAMPLE_RATE <= rate <= _MAX_SAMPLE_RATE:
            limits = f"{_MIN_SAMPLE_RATE} to {_MAX_SAMPLE_RATE} Hz"
            raise refusal(source, f"sample rate must be {limits}, got {rate}")
        sample_count, channel_count = samples.shape
        duration = sample_count / rate
        problem = too_much(duration, 0)
        if problem:
            raise refusal(source, problem)
        if channel_count > 2:
            raise refusal(source, f"must have 1 or 2 channels, got {channel_count}")
        if channel > channel_count:
            raise refusal(source, f"channel must be 1 to {channel_count}, got {channel}")
        pattern = pattern_of_signal(samples[:, channel - 1], rate)
        if channel_count == 2:
            remarks = (f"channel {channel} of 2 read", *pattern.remarks)
            return replace(pattern, remarks=remarks)
        return pattern


class _BandCourse(NamedTuple):
    """A band of a signal, at its points (n,)."""

    amplitude: FloatArray
    hertz: FloatArray
    """Center frequency."""


def pattern_of_signal(signal: FloatArray, rate: int) -> Pattern:
    """Return the pattern of a signal at a rate [Hz]."""
    import scipy.fft

    duration = len(signal) / rate
    # At least a second longer, so that the end does not wrap around to the start.
    length = scipy.fft.next_fast_len(len(signal) + rate, real=True)
    cycle = length / rate  # s
    spectrum = scipy.fft.rfft(signal, length)[1:] / length
    frequencies = np.arange(1, math.ceil(_HIGH_EDGE[1] * cycle)) / cycle
    in_band = _fade_in(frequencies, _LOW_EDGE) * _fade_out(frequencies, _HIGH_EDGE)
    filtered = spectrum[: len(in_band)] * in_band

    points = scipy.fft.next_fast_len(math.ceil(cycle * _POINT_RATE))
    step = cycle / points
    count = math.ceil(duration / step)
    lower = _band_course(filtered * _fade_out(frequencies, _SPLIT), points, step, count)
    upper = _band_course(filtered * _fade_in(frequencies, _SPLIT), points, step, count)
    intensity: FloatArray = np.hypot(lower.amplitude, upper.amplitude)
    intensity[intensity < _FLOOR * intensity.max()] = 0
    is_upper = upper.amplitude > lower.amplitude
    sharpness = sharpness_of(np.where(is_upper, upper.hertz, lower.hertz))

    times = (np.arange(count, dtype=float) + 0.5) * step
    times[-1] = min(times[-1], duration)
    is_felt = intensity > 0
    out_of_band_share = _out_of_band_share(spectrum, in_band)
    return Pattern(
        duration,
        _whole_curve(times, intensity, duration),
        thinned_curve(times[is_felt], sharpness[is_felt]),
        remarks=tuple(_signal_remarks(out_of_band_share, intensity)),
        out_of_band_share=out_of_band_share,
    )


def _whole_curve(times: FloatArray, intensity: FloatArray, duration: float) -> Curve:
    """Return the curve of an intensity, limited to 1, and constant up to both ends [s]."""
    all_times = np.concatenate([[0], times, [duration]])
    values = np.concatenate([intensity[:1], intensity, intensity[-1:]])
    return thinned_curve(all_times, values.clip(0, 1))


def _out_of_band_share(spectrum: Any, in_band: FloatArray) -> float:
    """Return the share of a spectrum's energy that a filter of its lowest lines removes."""
    power = abs(spectrum) ** 2
    total = float(power.sum())
    if not total:
        return 0.0
    kept_power = float((power[: len(in_band)] * in_band**2).sum())
    return 1 - kept_power / total


def _signal_remarks(out_of_band_share: float, intensity: FloatArray) -> Iterator[str]:
    """Yield a remark for each loss in the conversion of a signal."""
    if out_of_band_share > _MIN_LOST:
        level_db = 10 * math.log10(out_of_band_share)
        yield (
            f"{percent(out_of_band_share)} of its energy ({level_db:.1f} dB) "
            f"is outside {MIN_HZ:g} to {MAX_HZ:g} Hz and left out"
        )
    is_clamped = intensity > 1
    if is_clamped.any():
        yield f"{percent(is_clamped.mean())} of the time above full scale, clamped"


def _band_course(spectrum: Any, points: int, step: float, count: int) -> _BandCourse:
    """Return a band of a spectrum at its first points.

    points: number in the whole cycle, a step [s] apart.
    """
    bins = np.zeros(points * _PER_POINT, complex)
    bins[1 : len(spectrum) + 1] = 2 * spectrum
    analytic = np.fft.ifft(bins, norm="forward")
    power = (abs(analytic) ** 2).reshape(-1, _PER_POINT).mean(axis=1)
    turns = np.roll(analytic, -1) * analytic.conj()
    mean_turns = turns.reshape(-1, _PER_POINT).sum(axis=1)
    phase_steps = np.angle(mean_turns[:count])
    hertz = phase_steps * _PER_POINT / (2 * math.pi * step)
    return _BandCourse(np.sqrt(power[:count]), hertz)


def _fade_in(frequencies: FloatArray, edges: tuple[float, float]) -> FloatArray:
    """Return a rise from 0 to 1 between two frequencies; with `_fade_out`, powers add to 1."""
    low, high = edges
    share = np.log(frequencies / low) / math.log(high / low)
    return np.asarray(np.sin(share.clip(0, 1) * math.pi / 2))


def _fade_out(frequencies: FloatArray, edges: tuple[float, float]) -> FloatArray:
    """Return a fall from 1 to 0 between two frequencies."""
    low, high = edges
    return _fade_in(1 / frequencies, (1 / high, 1 / low))
