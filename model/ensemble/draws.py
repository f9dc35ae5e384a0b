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
from model.ensemble.contact_forms import power_of
from model.ensemble.tone_responses import DAMPING, FIRST_STIFFNESS, LOSS, NOMINAL


@dataclass(frozen=True, eq=False)
class Draws:
    """Factors of d plates, the first as modelled, the others from the thinnest to the thickest.

    factors: (columns, d) of the columns of `tone_responses`, and of one more for each thickness;
    errors: (k, d) of discretisation at each finger.
    """

    factors: Complex64Array
    errors: Complex64Array

    def accelerations(self, responses: Complex64Array, at_nodes: Complex64Array) -> Complex64Array:
        """Of responses (m, k p, columns): (m, k p, d).

        at_nodes (m, k p, thicknesses): nominal responses of plates of the thicknesses; all else is
        as on the plate as modelled.
        """
        changes = at_nodes - responses[:, :, NOMINAL, None]
        return np.asarray(np.concatenate([responses, changes], axis=2) @ self.factors)

    def power(self, accelerations: Complex64Array, error: Float32Array) -> Float32Array:
        """Squared amplitudes (m, k p, d) of accelerations, which are lost.

        error (m,): root mean square of the discretisation error.
        """
        by_finger = accelerations.reshape(
            len(accelerations), len(self.errors), -1, self.errors.shape[1]
        )
        by_finger += (error[:, None, None] * self.errors)[:, :, None]
        return power_of(accelerations)


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

    gain, phase [rad]: standard deviations of each ERA's; thicknesses: number of `thickness_nodes`
    that the plates have, 0 for all as modelled. Errors of discretisation are complex normal of mean
    square 1.
    """
    rng = np.random.default_rng([seed, era_count, finger_count])
    n, k = era_count, finger_count
    numbers = _exact(rng, 3 + n + k + 2 * n + 2 * k, count)
    numbers = numbers[:, numbers[0].argsort()]  # by thickness
    parameters, sizes, phases, real, imaginary = np.split(numbers, np.cumsum([3 + n + k, n, n, k]))
    factors = np.zeros((FIRST_STIFFNESS + n + k + n + thicknesses, 1 + count), dtype=np.complex64)
    factors[NOMINAL] = 1
    factors[[LOSS, DAMPING], 1:] = parameters[1:3]
    factors[FIRST_STIFFNESS : FIRST_STIFFNESS + n + k, 1:] = parameters[3:]
    gains = (1 + gain * sizes) * np.exp(1j * phase * phases) - 1
    factors[FIRST_STIFFNESS + n + k : FIRST_STIFFNESS + n + k + n, 1:] = gains
    if thicknesses:  # of each as many, or one less
        plates = np.arange(count)
        factors[-thicknesses + plates * thicknesses // count, 1 + plates] = 1
    errors = np.pad(math.sqrt(0.5) * (real + 1j * imaginary), ((0, 0), (1, 0)))
    drawn = Draws(factors, errors.astype(np.complex64))
    for shared in (drawn.factors, drawn.errors):
        shared.setflags(write=False)  # cached, and so shared
    return drawn


def _exact(rng: np.random.Generator, rows: int, count: int) -> np.ndarray:
    """Normal numbers (rows, count) with mean 0 and variance 1 in each row."""
    numbers = rng.standard_normal((rows, count))
    numbers -= numbers.mean(axis=1, keepdims=True)
    return np.asarray(numbers / np.sqrt((numbers**2).mean(axis=1, keepdims=True)))
