"""Fixed draws of plates within the uncertainty: exact in the thickness, else to first order.

Drawn once for each number of ERAs and fingers: standard normal numbers whose mean and variance are
made exact, so that a few draws give the percentiles of many. Those by which candidates are judged
differ from those of the promise, which would else be flattered.
"""

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from model.arrays import Complex64Array, Float32Array
from model.ensemble.thickness import thickness_nodes
from model.ensemble.tone_responses import DAMPING, FIRST_STIFFNESS, LOSS, NOMINAL, THICKNESS


@dataclass(frozen=True, eq=False)
class Draws:
    """Factors of d plates, the first as modelled.

    rows: (2 columns, 2 d) of real and imaginary parts of the columns of `tone_responses`, that give
    first all real and then all imaginary parts; errors: (k, 2 d) of discretisation at each finger.
    """

    rows: Float32Array
    errors: Float32Array

    def power(self, responses: Complex64Array, error: Float32Array) -> Float32Array:
        """Squared amplitudes (m, k p, d) of responses (m, k p, columns).

        error (m,): root mean square of the discretisation error.
        """
        m, points, _ = responses.shape
        parts = responses.reshape(m * points, -1).view(np.float32) @ self.rows
        each = parts.reshape(m, len(self.errors), -1, parts.shape[1])
        each += (error[:, None, None] * self.errors)[:, :, None]
        parts *= parts
        d = parts.shape[1] // 2
        return np.asarray((parts[:, :d] + parts[:, d:]).reshape(m, points, d))


@lru_cache(maxsize=64)
def draw(
    era_count: int,
    finger_count: int,
    *,
    count: int,
    seed: int,
    gain: float,
    phase: float,
    thicknesses: int = 0,
) -> Draws:
    """Draw plates, count beside that as modelled.

    gain, phase [rad]: standard deviations of each ERA's; thicknesses: number of `thickness_nodes`,
    which have a column each after those of `tone_responses`, of `thickness_remainders`, 0 for
    thicknesses that count in proportion. Errors of discretisation are complex normal of mean square
    1.
    """
    rng = np.random.default_rng([seed, era_count, finger_count])
    n, k = era_count, finger_count
    numbers = _exact(rng, 3 + n + k + 2 * n + 2 * k, count)
    parameters, sizes, phases, real, imaginary = np.split(numbers, np.cumsum([3 + n + k, n, n, k]))
    factors = np.zeros((4 + n + k + n + thicknesses, 1 + count), dtype=np.complex64)
    factors[NOMINAL] = 1
    if thicknesses:
        # By rank, so that each has as many plates, or one less.
        node = parameters[0].argsort().argsort() * thicknesses // count
        parameters[0] = thickness_nodes(thicknesses)[node]
        factors[-thicknesses + node, 1 + np.arange(count)] = 1
    factors[[THICKNESS, LOSS, DAMPING], 1:] = parameters[:3]
    factors[FIRST_STIFFNESS : FIRST_STIFFNESS + n + k, 1:] = parameters[3:]
    gains = (1 + gain * sizes) * np.exp(1j * phase * phases) - 1
    factors[FIRST_STIFFNESS + n + k : FIRST_STIFFNESS + n + k + n, 1:] = gains
    rows = np.stack([factors, 1j * factors], axis=1).reshape(2 * len(factors), -1)
    errors = math.sqrt(0.5) * np.pad(np.stack([real, imaginary], axis=1), ((0, 0), (0, 0), (1, 0)))
    drawn = Draws(
        np.concatenate([rows.real, rows.imag], axis=1),
        errors.reshape(k, -1).astype(np.float32),
    )
    for shared in (drawn.rows, drawn.errors):
        shared.setflags(write=False)  # cached, and so shared
    return drawn


def _exact(rng: np.random.Generator, rows: int, count: int) -> np.ndarray:
    """Normal numbers (rows, count) with mean 0 and variance 1 in each row."""
    numbers = rng.standard_normal((rows, count))
    numbers -= numbers.mean(axis=1, keepdims=True)
    return np.asarray(numbers / np.sqrt((numbers**2).mean(axis=1, keepdims=True)))
