"""Footprints: the discs or points of the plate on which attachments act.

A footprint is x, y and radius [m]; the radius of a point is 0. A force on a disc is distributed
evenly over the part of the disc on the plate, and the attachment follows the mean deflection there.
"""

from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np
from numpy.polynomial.legendre import leggauss
from numpy.typing import NDArray
from scipy import sparse

from model.arrays import FloatArray
from model.errors import InputError

BasisT = TypeVar("BasisT", FloatArray, NDArray[np.float32], sparse.csr_array)

# Gauss rules across a disc and along each of its chords: enough for fields that vary over its
# radius.
_ACROSS, _ACROSS_WEIGHTS = leggauss(10)
_ALONG, _ALONG_WEIGHTS = leggauss(8)


def as_footprints(places: FloatArray) -> FloatArray:
    """Convert footprints (n, 3) or points (n, 2) to footprints x, y, radius [m], (n, 3)."""
    places = np.atleast_2d(np.asarray(places, dtype=float))
    if places.size == 0:
        return np.empty((0, 3))
    return places if places.shape[1] == 3 else np.column_stack([places, np.zeros(len(places))])


def check_footprints_on_plate(places: FloatArray, *, length: float, width: float) -> None:
    """Check that points (n, 2) or the centers of footprints (n, 3) [m] are on the plate.

    The plate includes its edges. Raises InputError.
    """
    sides = np.array([length, width])
    tolerance = 1e-9 * sides.max()
    centers = places[:, :2]
    is_on_plate = ((centers >= -tolerance) & (centers <= sides + tolerance)).all(axis=1)
    if not is_on_plate.all():
        x, y = centers[np.argmin(is_on_plate)]
        raise InputError(
            f"point must be on the plate, (0, 0) to ({length:g}, {width:g}) m, got ({x:g}, {y:g}) m"
        )


def mean_over(
    evaluate: Callable[[FloatArray], BasisT], places: FloatArray, *, length: float, width: float
) -> BasisT:
    """Mean of functions (p, m) over footprints (n, 3) or points (n, 2) [m] of a plate, (n, m).

    evaluate: the functions at points (p, 2).
    """
    footprints = as_footprints(places)
    is_disc = footprints[:, 2] > 0
    if not is_disc.any():
        return evaluate(footprints[:, :2])
    counts = np.where(is_disc, len(_ACROSS) * len(_ALONG), 1)
    ends = np.concatenate([[0], np.cumsum(counts)])
    points = np.repeat(footprints[:, :2], counts, axis=0)
    values = np.ones(len(points))
    on_discs = np.repeat(is_disc, counts)
    points[on_discs], values[on_discs] = _disc_rule(footprints[is_disc], length, width)
    shape = (len(footprints), len(points))
    weights = sparse.csr_array((values, np.arange(len(points)), ends), shape=shape)
    mean: Any = weights @ evaluate(points)
    return mean  # type: ignore[no-any-return]


def _disc_rule(discs: FloatArray, length: float, width: float) -> tuple[FloatArray, FloatArray]:
    """Gauss points (p, 2) on the parts of discs (n, 3) on the plate, and their weights (p,).

    The weights of each disc add up to 1. The chords are at x + radius sin(angle), because their
    ends are smooth in the angle.
    """
    x, y, radius = discs[:, :, None].transpose(1, 0, 2)
    first = np.arcsin(np.clip(-x / radius, -1, 1))
    last = np.arcsin(np.clip((length - x) / radius, -1, 1))
    angles = (first + last) / 2 + (last - first) / 2 * _ACROSS
    half_chord = radius * np.cos(angles)
    low = np.maximum(y - half_chord, 0.0)
    high = np.minimum(y + half_chord, width)
    chord_y = (low + high)[..., None] / 2 + (high - low)[..., None] / 2 * _ALONG
    chord_x = np.broadcast_to((x + radius * np.sin(angles))[..., None], chord_y.shape)
    weights = (_ACROSS_WEIGHTS * half_chord * (high - low))[..., None] * _ALONG_WEIGHTS
    weights /= weights.sum(axis=(1, 2), keepdims=True)
    return np.stack([chord_x, chord_y], axis=-1).reshape(-1, 2), weights.ravel()
