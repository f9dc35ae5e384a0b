"""Fixed draws of plates within the uncertainty, to first order.

Drawn once for each number of ERAs and fingers: standard normal numbers whose mean and variance are
made exact, so that a few draws give the percentiles of many. Those by which candidates are judged
differ from those of the promise, which would else be flattered.
"""

import math
from functools import lru_cache

import numpy as np

from model.arrays import Complex64Array
from model.ensemble.tone_responses import DAMPING, FIRST_STIFFNESS, LOSS, NOMINAL, THICKNESS


@lru_cache(maxsize=64)
def draw(
    era_count: int, finger_count: int, *, count: int, seed: int, gain: float, phase: float
) -> Complex64Array:
    """Draw factors (columns, count) of the columns of `tone_responses`.

    gain, phase [rad]: standard deviations of each ERA's. Errors of discretisation are complex
    normal of mean square 1.
    """
    rng = np.random.default_rng([seed, era_count, finger_count])
    n, k = era_count, finger_count
    numbers = _exact(rng, 3 + n + k + 2 * n + 2 * k, count)
    parameters, sizes, phases, real, imaginary = np.split(numbers, np.cumsum([3 + n + k, n, n, k]))
    factors = np.empty((4 + n + k + n + k, count), dtype=np.complex64)
    factors[NOMINAL] = 1
    factors[[THICKNESS, LOSS, DAMPING]] = parameters[:3]
    factors[FIRST_STIFFNESS : FIRST_STIFFNESS + n + k] = parameters[3:]
    gains = (1 + gain * sizes) * np.exp(1j * phase * phases) - 1
    factors[FIRST_STIFFNESS + n + k :] = np.concatenate(
        [gains, math.sqrt(0.5) * (real + 1j * imaginary)]
    )
    factors.setflags(write=False)  # cached, and so shared
    return factors


def _exact(rng: np.random.Generator, rows: int, count: int) -> np.ndarray:
    """Normal numbers (rows, count) with mean 0 and variance 1 in each row."""
    numbers = rng.standard_normal((rows, count))
    numbers -= numbers.mean(axis=1, keepdims=True)
    return np.asarray(numbers / np.sqrt((numbers**2).mean(axis=1, keepdims=True)))
