"""Fixed draws of plates within the uncertainty: exact in the thickness, else to first order.

Drawn once for each number of ERAs and fingers: standard normal numbers whose mean and variance are
made exact, so that a few draws give the percentiles of many. Those by which candidates are judged
differ from those of the promise, which would else be flattered. Nine of ten give what is promised.
"""

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from model.arrays import Complex64Array, Float32Array, FloatArray, IntArray


@dataclass(frozen=True)
class Drawing:
    """How many plates are drawn, of how many thicknesses.

    bases: thicknesses at which the changes by all else that is uncertain are computed, each for as
    many plates; 1 for the nominal plate.
    """

    count: int
    seed: int
    thicknesses: int
    bases: int = 1


JUDGING_DRAWS = Drawing(count=64, seed=1, thicknesses=5)
PROMISED_DRAWS = Drawing(count=200, seed=8, thicknesses=40, bases=5)
"""Drawn plates that judge candidates, and those of the promise."""

COMMON = 2.0
"""Standard deviations by which the gain of all ERAs together is off on drawn plates."""


@dataclass(frozen=True, eq=False)
class Draws:
    """Parameters of d plates from the thinnest to the thickest, in standard deviations.

    loss, damping (d,): of the plate, and of all ERAs; own (a, d): stiffness of each ERA and of
    masses up to the last foot, nothing of others, load of each finger; gains (a, d): relative
    change of each ERA's, complex; errors (k, d): of discretisation at each finger, complex of mean
    square 1; harmonics (n, d): second harmonic of each ERA, complex, relative to its motion; node
    (d,): which of the thicknesses each has.
    """

    loss: Float32Array
    damping: Float32Array
    own: Float32Array
    gains: Complex64Array
    errors: Complex64Array
    harmonics: Complex64Array
    node: IntArray


@lru_cache(maxsize=64)
def draw(
    era_count: int,
    finger_count: int,
    *,
    masses: int = 0,
    to_feet: int = 0,
    count: int,
    seed: int,
    gain: float,
    phase: float,
    common_gain: float,
    harmonic: float,
    thicknesses: int,
) -> Draws:
    """Draw plates of ERAs, masses and fingers, of a number of thicknesses.

    to_feet: of the masses, up to the last foot that deviates; gain, phase [rad]: standard
    deviations of each ERA's; common_gain: of all together; harmonic: root mean square of each
    ERA's. Of each thickness as many plates, or one less. All answers of a plate share its common
    gain: half of the plates have it COMMON standard deviations low, the others high, so that a
    plate whose own is no farther off keeps nine of ten levels.
    """
    rng = np.random.default_rng([seed, era_count, finger_count])
    n, k = era_count, finger_count
    # Those of feet last, so that all else of a rig stays.
    numbers = standard_normal(rng, 3 + n + k + 2 * n + 2 * k + 1 + 2 * n + to_feet, count)
    numbers = numbers[:, numbers[0].argsort()]  # by thickness
    parameters, sizes, phases, real, imaginary, common, harmonics, quadrature, feet = np.split(
        numbers, np.cumsum([3 + n + k, n, n, k, k, 1, n, n])
    )
    common = np.where(common > np.median(common), COMMON, -COMMON)
    gains = (1 + gain * sizes) * np.exp(1j * phase * phases + common_gain * common) - 1
    of_masses = np.pad(feet, ((0, masses - to_feet), (0, 0)))
    own = np.insert(parameters[3:], [n] * masses, of_masses, axis=0)
    drawn = Draws(
        loss=parameters[1].astype(np.float32),
        damping=parameters[2].astype(np.float32),
        own=own.astype(np.float32),
        gains=np.pad(gains, ((0, masses + k), (0, 0))).astype(np.complex64),
        errors=_complex(real, imaginary),
        harmonics=_complex(harmonics, quadrature, harmonic),
        node=np.arange(count) * thicknesses // count,
    )
    for shared in vars(drawn).values():
        shared.setflags(write=False)  # cached, and so shared
    return drawn


def _complex(real: FloatArray, imaginary: FloatArray, size: float = 1.0) -> Complex64Array:
    """Complex normal numbers of a root mean square, of normal ones."""
    return np.asarray(math.sqrt(0.5) * size * (real + 1j * imaginary), dtype=np.complex64)


def standard_normal(rng: np.random.Generator, rows: int, count: int) -> np.ndarray:
    """Normal numbers (rows, count) with mean 0 and variance 1 in each row."""
    numbers = rng.standard_normal((rows, count))
    numbers -= numbers.mean(axis=1, keepdims=True)
    return np.asarray(numbers / np.sqrt((numbers**2).mean(axis=1, keepdims=True)))


PERCENTILE = 10
"""Percentile of the drawn plates that is promised: nine of ten have more."""


def over_fingertips(
    power: Float32Array | FloatArray, weights: Float32Array
) -> tuple[Float32Array, Float32Array]:
    """Mean amplitude, and squared one at the loudest point, of squared ones (c, k p, d): (c, k, d).

    weights (k, p): of the points in the mean.
    """
    by_finger = power.reshape(len(power), *weights.shape, -1)
    means = np.asarray((weights[:, None] @ np.sqrt(by_finger))[:, :, 0])
    loudest = np.maximum.reduce(by_finger, axis=2)
    return means, np.asarray(loudest)


def percentile(values: FloatArray, percent: float = PERCENTILE) -> FloatArray:
    """Percentile over the last axis, linear between values (...,)."""
    ordered = np.sort(values, axis=-1)
    place = percent / 100 * (ordered.shape[-1] - 1)
    low = int(place)
    high = min(low + 1, ordered.shape[-1] - 1)
    return np.asarray(ordered[..., low] + (place - low) * (ordered[..., high] - ordered[..., low]))
