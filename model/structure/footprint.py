"""Footprints: discs of the plate on which ERAs, masses and fingertips act, or points.

A point force dents a plate with shear deformation without limit, as the logarithm of its size; a
disc does not. A force on a disc is spread evenly over the part of it that is on the plate, and what
it acts on follows the mean deflection of that part.
"""

from collections.abc import Callable
from functools import lru_cache
from typing import Any, TypeVar

import numpy as np
from numpy.polynomial.legendre import leggauss
from numpy.typing import NDArray
from scipy import sparse

from model.arrays import FloatArray
from model.errors import InputError

# Gauss points across a disc and along each chord: enough for fields that vary over its radius.
_ACROSS, _ALONG = 10, 8

BasisT = TypeVar("BasisT", FloatArray, NDArray[np.float32], sparse.csr_array)


def as_footprints(places: FloatArray) -> FloatArray:
    """Footprints x, y, radius [m], (n, 3), of these or of points (n, 2)."""
    places = np.atleast_2d(np.asarray(places, dtype=float))
    if places.size == 0:
        return np.empty((0, 3))
    return places if places.shape[1] == 3 else np.column_stack([places, np.zeros(len(places))])


def check_on_plate(places: FloatArray, *, length: float, width: float) -> None:
    """Check that points (n, 2) or the centres of footprints (n, 3) [m] are on the plate.

    Its edges included; raises InputError.
    """
    sides = np.array([length, width])
    tolerance = 1e-9 * sides.max()
    at = places[:, :2]
    off = ~((at >= -tolerance) & (at <= sides + tolerance)).all(axis=1)
    if off.any():
        x, y = at[np.argmax(off)]
        raise InputError(
            f"point must be on the plate, (0, 0) to ({length:g}, {width:g}) m, got ({x:g}, {y:g}) m"
        )


def mean_over(
    evaluate: Callable[[FloatArray], BasisT], places: FloatArray, *, length: float, width: float
) -> BasisT:
    """Mean of functions (p, m) over footprints (n, 3) or points (n, 2) [m] of a plate, (n, m).

    evaluate: the functions at points (p, 2).
    """
    places = np.atleast_2d(np.asarray(places, dtype=float))
    if places.shape[1] == 2 or not places[:, 2].any():
        return evaluate(places[:, :2])
    points, weights = _quadrature(places, length, width)
    mean: Any = weights @ evaluate(points)
    return mean  # type: ignore[no-any-return]


def _quadrature(
    places: FloatArray, length: float, width: float
) -> tuple[FloatArray, sparse.csr_array]:
    """Points (p, 2) on footprints, and weights of each footprint's mean, (n, p)."""
    is_disc = places[:, 2] > 0
    counts = np.where(is_disc, _ACROSS * _ALONG, 1)
    ends = np.concatenate([[0], np.cumsum(counts)])
    points = np.repeat(places[:, :2], counts, axis=0)
    values = np.ones(len(points))
    on_discs = np.repeat(is_disc, counts)
    points[on_discs], values[on_discs] = _on_discs(places[is_disc], length, width)
    shape = (len(places), len(points))
    return points, sparse.csr_array((values, np.arange(len(points)), ends), shape=shape)


def _on_discs(discs: FloatArray, length: float, width: float) -> tuple[FloatArray, FloatArray]:
    """Gauss points (p, 2) on the parts of discs (n, 3) on the plate, and their weights (p,).

    Weights of a disc add up to 1.
    """
    across, across_weights = _gauss(_ACROSS)
    along, along_weights = _gauss(_ALONG)
    x, y, radius = discs[:, :, None].transpose(1, 0, 2)
    # x + radius sin(angle): the ends of the chords are then smooth in the angle.
    first = np.arcsin(np.clip(-x / radius, -1, 1))
    last = np.arcsin(np.clip((length - x) / radius, -1, 1))
    angles = (first + last) / 2 + (last - first) / 2 * across
    half = radius * np.cos(angles)
    low, high = np.maximum(y - half, 0.0), np.minimum(y + half, width)
    chord_y = (low + high)[..., None] / 2 + (high - low)[..., None] / 2 * along
    chord_x = np.broadcast_to((x + radius * np.sin(angles))[..., None], chord_y.shape)
    weights = (across_weights * half * (high - low))[..., None] * along_weights
    weights /= weights.sum(axis=(1, 2), keepdims=True)
    return np.stack([chord_x, chord_y], axis=-1).reshape(-1, 2), weights.ravel()


@lru_cache(maxsize=4)
def _gauss(count: int) -> tuple[FloatArray, FloatArray]:
    return leggauss(count)
