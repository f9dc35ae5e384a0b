"""What fingers feel on drawn plates: levels at the targets, and contrast to the quiet fingers."""

from dataclasses import dataclass

import numpy as np

from model.arrays import Float32Array, FloatArray, IntArray

PERCENTILE = 10
"""Percentile of the drawn plates that is promised: nine of ten have more."""


@dataclass(frozen=True, eq=False)
class Fingertips:
    """Points of the fingers, target fingers first.

    weights (k, p): in the mean over each fingertip; gains (t,): factors on the targets.
    """

    weights: Float32Array
    gains: Float32Array


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
    fingertips: Fingertips,
) -> Felt:
    """Measure squared amplitudes (m, k p, d) of tones; starts (c,): the first tone of each drive.

    threshold (m,) [m/s²]. Tones of one drive are felt as the root of the sum of their squares over
    thresholds; their peak accelerations add (paper Eq. 28). The result has plates (c, d).
    """
    is_mixed = len(starts) < len(power)
    if is_mixed:
        sensed = np.add.reduceat(power / (threshold**2)[:, None, None], starts, axis=0)
        level, loudest = _weakest_and_loudest(sensed, fingertips)
    else:
        level, loudest = _weakest_and_loudest(power, fingertips) / threshold[:, None]
    if len(fingertips.weights) == len(fingertips.gains):
        return Felt(level, None)
    contrast = level / loudest
    if not is_mixed:
        return Felt(level, Contrasts(loudest, contrast, contrast))
    peak = np.add.reduceat(np.sqrt(power), starts, axis=0)
    weakest, loud = _weakest_and_loudest(peak * peak, fingertips)
    return Felt(level, Contrasts(loudest, contrast, weakest / loud))


def _weakest_and_loudest(power: Float32Array | FloatArray, fingertips: Fingertips) -> FloatArray:
    """Amplitudes (2, c, d) of squared ones (c, k p, d).

    Of the mean at the weakest target, and the maximum over all quiet points.
    """
    c, _, d = power.shape
    p, t = fingertips.weights.shape[1], len(fingertips.gains)
    at_targets = np.sqrt(power[:, : t * p]).reshape(c, t, p, d)
    means = (fingertips.weights[:t, None] @ at_targets)[:, :, 0]
    weakest = np.minimum.reduce(means * fingertips.gains[:, None], axis=1)
    loudest = np.maximum.reduce(power[:, t * p :], axis=1, initial=0)
    return np.array([weakest, np.maximum(np.sqrt(loudest), 1e-30)])


def percentile(values: FloatArray, percent: float = PERCENTILE) -> FloatArray:
    """Percentile over the last axis, linear between values (...,)."""
    return percentile_of_sorted(np.sort(values, axis=-1), percent)


def percentile_of_sorted(ordered: FloatArray, percent: float) -> FloatArray:
    """As `percentile`, of values that are in ascending order."""
    place = percent / 100 * (ordered.shape[-1] - 1)
    low = int(place)
    high = min(low + 1, ordered.shape[-1] - 1)
    return np.asarray(ordered[..., low] + (place - low) * (ordered[..., high] - ordered[..., low]))
