"""Whether inputs have the clock of the outputs: periods of a multisine shift otherwise.

Two devices, or an aggregate of two, drift by 10 to 100 millionths. What is played in several runs
is then no longer orthogonal, and nothing else shows it where the loop-back has the right clock.
"""

from collections.abc import Sequence

import numpy as np

from model.arrays import FloatArray
from sim.measuring.multisine import PERIOD, Multisine

TOLERANCE = 2e-6
"""Of a clock; 13 s of measuring turn 500 Hz by 5 degrees."""

_MAX_DRIFT = 1e-3  # a lost block of 64 samples at 48 kHz looks like more
_ALIKE = 0.999
_SURE = 5.0  # standard errors


def certain_drift(multisine: Multisine, runs: Sequence[FloatArray]) -> float:
    """Drift of an input's clock relative to the outputs', from whole periods of each run, (n,).

    Least squares of the phase 2 pi f t drift between the first and the last period, t apart,
    weighted by the power of each line. 0 where that is within its error, or not all that makes
    periods differ, as a lost block does.
    """
    n = multisine.samples
    first = np.array([multisine.found(each[:n]) for each in runs])
    last = np.array([multisine.found(each[-n:]) for each in runs])
    apart = PERIOD * (len(runs[0]) / n - 1)
    turned = last * first.conj()
    weights = np.abs(turned)
    slopes = np.broadcast_to(2 * np.pi * multisine.frequencies * apart, weights.shape)
    phases = np.angle(turned)
    moment = max(float((weights * slopes**2).sum()), 1e-300)
    relative = float((weights * slopes * phases).sum()) / moment
    rest = phases - slopes * relative
    error = np.sqrt(float((weights**2 * slopes**2 * rest**2).sum())) / moment
    alike = np.abs((turned * np.exp(-1j * slopes * relative)).sum()) / max(weights.sum(), 1e-300)
    size = abs(relative)
    is_certain = TOLERANCE < size < _MAX_DRIFT and size > _SURE * error and alike > _ALIKE
    return relative if is_certain else 0.0
