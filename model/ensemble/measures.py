"""What fingers feel on drawn plates: levels at the targets, and contrast to the quiet fingers."""

from dataclasses import dataclass

import numpy as np

from model.arrays import Complex64Array, Float32Array, FloatArray, IntArray

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
    responses: Complex64Array, threshold: Float32Array, starts: IntArray, fingertips: Fingertips
) -> Felt:
    """Measure responses (m, k p, d) of tones; starts (c,): the first tone of each drive.

    threshold (m,) [m/s²]. Tones of one drive are felt as the root of the sum of their squares over
    thresholds; their peak accelerations add (paper Eq. 28). The result has plates (c, d).
    """
    m, _, d = responses.shape
    squares = responses.real**2 + responses.imag**2
    is_mixed = len(starts) < m
    sensed = squares / (threshold**2)[:, None, None]
    if is_mixed:
        sensed = np.add.reduceat(sensed, starts, axis=0)
    k, p = fingertips.weights.shape
    level, loudest = _weakest_and_loudest(np.sqrt(sensed).reshape(len(starts), k, p, d), fingertips)
    if loudest is None:
        return Felt(level, None)
    contrast = level / loudest
    if not is_mixed:
        return Felt(level, Contrasts(loudest, contrast, contrast))
    peak = np.add.reduceat(np.sqrt(squares), starts, axis=0).reshape(len(starts), k, p, d)
    weakest, loud = _weakest_and_loudest(peak, fingertips)
    return Felt(level, Contrasts(loudest, contrast, weakest / np.asarray(loud)))


def _weakest_and_loudest(
    amplitudes: Float32Array, fingertips: Fingertips
) -> tuple[FloatArray, FloatArray | None]:
    """Mean at the weakest target (c, d), and maximum over all quiet points, of (c, k, p, d)."""
    t = len(fingertips.gains)
    means = np.einsum("tp,ctpd->ctd", fingertips.weights[:t], amplitudes[:, :t])
    weakest = (means * fingertips.gains[:, None]).min(axis=1)
    if amplitudes.shape[1] == t:
        return weakest, None
    loudest = np.maximum.reduce(amplitudes[:, t:].reshape(len(weakest), -1, weakest.shape[-1]), 1)
    return weakest, np.maximum(loudest, 1e-30)


def percentile(values: FloatArray, percent: float = PERCENTILE) -> FloatArray:
    """Percentile over the last axis, linear between values (...,)."""
    place = percent / 100 * (values.shape[-1] - 1)
    low = int(place)
    ordered = np.sort(values, axis=-1)
    high = min(low + 1, values.shape[-1] - 1)
    return np.asarray(ordered[..., low] + (place - low) * (ordered[..., high] - ordered[..., low]))
