"""What fingers feel on drawn plates: levels at the targets, and contrast to the quiet fingers."""

from dataclasses import dataclass, replace

import numpy as np

from model.arrays import Float32Array, FloatArray, IntArray

PERCENTILE = 10
"""Percentile of the drawn plates that is promised: nine of ten have more."""


@dataclass(frozen=True, eq=False)
class Contrasts:
    """Measures at the loudest quiet point on plates (..., d).

    loudest: amplitude to threshold there; felt: that at the weakest target to it; acceleration: the
    same ratio of peak accelerations.
    """

    loudest: FloatArray
    felt: FloatArray
    acceleration: FloatArray


@dataclass(frozen=True, eq=False)
class Felt:
    """What fingers feel of drives at full level on plates (..., d).

    level: amplitude to threshold at the weakest target; contrast: None without quiet fingers.
    """

    level: FloatArray
    contrast: Contrasts | None


def felt(
    power: Float32Array | FloatArray,
    threshold: Float32Array,
    starts: IntArray,
    weights: Float32Array,
    targets: int,
) -> Felt:
    """Measure squared amplitudes (m, k p, d) of tones; starts (c,): the first tone of each drive.

    threshold (m,) [m/s²]; weights (k, p): of the points in the mean over each fingertip; targets:
    number of fingers that are, which come first. Tones of one drive are felt as the root of the sum
    of their squares over thresholds; their peak accelerations add (paper Eq. 28). The result has
    plates (c, d).
    """
    is_mixed = len(starts) < len(power)
    sensed = power / (threshold**2)[:, None, None]
    if is_mixed:
        sensed = np.add.reduceat(sensed, starts, axis=0)
    found = felt_at(*over_fingertips(sensed, weights), targets)
    if found.contrast is None or not is_mixed:
        return found
    peak = np.add.reduceat(np.sqrt(power), starts, axis=0)
    peaks = felt_at(*over_fingertips(peak * peak, weights), targets)
    if peaks.contrast is None:
        raise AssertionError("fingers are the same")
    return Felt(found.level, replace(found.contrast, acceleration=peaks.contrast.felt))


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


def felt_at(means: Float32Array, loudest: Float32Array, targets: int) -> Felt:
    """Measure drives of which every fingertip feels so much, as `over_fingertips`.

    targets: number of fingers that are, which come first.
    """
    level = np.minimum.reduce(means[:, :targets], axis=1)
    if means.shape[1] == targets:
        return Felt(level, None)
    loud = np.maximum(np.sqrt(np.maximum.reduce(loudest[:, targets:], axis=1)), 1e-30)
    contrast = level / loud
    return Felt(level, Contrasts(loud, contrast, contrast))


def percentile(values: FloatArray, percent: float = PERCENTILE) -> FloatArray:
    """Percentile over the last axis, linear between values (...,)."""
    return percentile_of_sorted(np.sort(values, axis=-1), percent)


def percentile_of_sorted(ordered: FloatArray, percent: float) -> FloatArray:
    """As `percentile`, of values that are in ascending order."""
    place = percent / 100 * (ordered.shape[-1] - 1)
    low = int(place)
    high = min(low + 1, ordered.shape[-1] - 1)
    return np.asarray(ordered[..., low] + (place - low) * (ordered[..., high] - ordered[..., low]))
