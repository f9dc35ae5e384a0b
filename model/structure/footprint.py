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
    points: list[FloatArray] = []
    values: list[FloatArray] = []
    for x, y, radius in places:
        if radius == 0:
            points.append(np.array([[x, y]]))
            values.append(np.ones(1))
        else:
            on_disc, weights = _on_disc(x, y, radius, length, width)
            points.append(on_disc)
            values.append(weights / weights.sum())
    ends = np.cumsum([0, *map(len, values)])
    shape = (len(places), int(ends[-1]))
    means = sparse.csr_array((np.concatenate(values), np.arange(ends[-1]), ends), shape=shape)
    return np.concatenate(points), means


def _on_disc(
    x: float, y: float, radius: float, length: float, width: float
) -> tuple[FloatArray, FloatArray]:
    """Gauss points (p, 2) on the part of a disc that is on the plate, and their weights (p,)."""
    across, across_weights = _gauss(_ACROSS)
    along, along_weights = _gauss(_ALONG)
    # x + radius sin(angle): the ends of the chords are then smooth in the angle.
    first = np.arcsin(np.clip(-x / radius, -1, 1))
    last = np.arcsin(np.clip((length - x) / radius, -1, 1))
    angles = (first + last) / 2 + (last - first) / 2 * across
    half = radius * np.cos(angles)
    low, high = np.maximum(y - half, 0.0), np.minimum(y + half, width)
    chord_y = (low + high)[:, None] / 2 + (high - low)[:, None] / 2 * along
    chord_x = np.broadcast_to((x + radius * np.sin(angles))[:, None], chord_y.shape)
    weights = (across_weights * half * (high - low))[:, None] * along_weights
    return np.column_stack([chord_x.ravel(), chord_y.ravel()]), weights.ravel()


@lru_cache(maxsize=4)
def _gauss(count: int) -> tuple[FloatArray, FloatArray]:
    return leggauss(count)
