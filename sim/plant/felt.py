"""Vibration felt by a finger in a time window: peaks and steady amplitudes."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from model.arrays import FloatArray
from sim.plant.finger import Record


@dataclass(frozen=True)
class Felt:
    """points (p, 2) [m]; frequencies (f,) [Hz]; amplitude (f, p) [m/s²]; peak (p,) [m/s²]."""

    points: FloatArray
    frequencies: tuple[float, ...]
    amplitude: FloatArray
    peak: FloatArray


def feel(record: Record, frequencies: Sequence[float]) -> Felt:
    """Peak at each point, and the amplitude of each frequency [Hz] by least squares.

    The fit of sines and cosines assumes steady vibration: the window must exclude transients, and
    be longer than the inverse of the smallest frequency difference. With fewer samples than
    unknowns the result is the minimum-norm solution.
    """
    times, samples = record.times, record.accelerations
    if not len(times):
        nothing = np.zeros(len(record.points))
        return Felt(
            record.points, tuple(frequencies), np.zeros((len(frequencies), len(nothing))), nothing
        )
    angles = 2 * np.pi * np.outer(times - times[0], np.asarray(frequencies, dtype=float))
    basis = np.hstack([np.sin(angles), np.cos(angles)])
    fit = np.linalg.lstsq(basis, samples, rcond=None)[0]
    sine, cosine = np.split(fit, 2)
    return Felt(
        points=record.points,
        frequencies=tuple(frequencies),
        amplitude=np.hypot(sine, cosine),
        peak=np.abs(samples).max(axis=0),
    )
