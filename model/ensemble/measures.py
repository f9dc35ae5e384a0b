"""What fingers feel on drawn plates: over their tips, and on nine of ten plates."""

import numpy as np

from model.arrays import Float32Array, FloatArray

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
