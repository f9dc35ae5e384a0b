"""Vibration felt by a finger in a time window: peaks and steady amplitudes."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from model.arrays import ComplexArray, FloatArray
from model.finger.perception import felt_part
from sim.plant.fingers import Record


@dataclass(frozen=True)
class Felt:
    """points (p, 2) [m]; frequencies (f,) [Hz]; amplitude (f, p) [m/s²]; peak (p,) [m/s²].

    weights (p,): of the points in the mean over the fingertip.
    """

    points: FloatArray
    weights: FloatArray
    frequencies: tuple[float, ...]
    amplitude: FloatArray
    peak: FloatArray


def measure_vibration(record: Record, frequencies: Sequence[float]) -> Felt:
    """Peak at each point up to 1 kHz, and the amplitude of each frequency [Hz] by least squares.

    The fit of sines and cosines assumes steady vibration: the window must exclude transients, and
    be longer than the inverse of the smallest frequency difference. With fewer samples than
    unknowns the result is the minimum-norm solution.
    """
    times, samples = record.times, record.accelerations
    count, points = len(frequencies), len(record.points)
    if not len(times):
        amplitude, peak = np.zeros((count, points)), np.zeros(points)
    else:
        amplitude = np.abs(fit_tones(times - times[0], samples, frequencies))
        peak = felt_peaks(times, samples)
    return Felt(record.points, record.weights, tuple(frequencies), amplitude, peak)


def felt_peaks(times: FloatArray, samples: FloatArray) -> FloatArray:
    """Peaks (p,) of what skin can feel of evenly spaced samples (n, p) at times (n,) [s]."""
    if len(times) < 2:
        return np.asarray(np.abs(samples).max(axis=0))
    rate = (len(times) - 1) / (times[-1] - times[0])
    return np.asarray(np.abs(felt_part(samples, round(rate, 3))).max(axis=0))


def fit_tones(
    times: FloatArray,
    samples: FloatArray,
    frequencies: Sequence[float],
    *,
    with_offset: bool = False,
) -> ComplexArray:
    """Complex amplitudes a (f, p) of Im[a exp(i omega t)] in samples (n, p), by least squares.

    frequencies [Hz]; with_offset: fit a constant, too.
    """
    angles = 2 * np.pi * np.outer(times, np.asarray(frequencies, dtype=float))
    offset = np.ones((len(times), int(with_offset)))
    basis = np.hstack([np.sin(angles), np.cos(angles), offset])
    fit = np.linalg.lstsq(basis, samples, rcond=None)[0]
    count = len(frequencies)
    return np.asarray(fit[:count] + 1j * fit[count : 2 * count])
