"""Derivatives of fields of a plate by the places of the points where they are taken.

Differences of second order, inwards at edges. Closed forms would be simple for polynomials, but a
footprint that an edge cuts adds integrals along that edge, and the compliance of unresolved waves
is fitted, with limits beside edges. Over this step differences are right to 1e-6 of the largest,
and the rounding of another processor changes them by 3e-8.
"""

from collections.abc import Callable

import numpy as np

from model.arrays import FloatArray

STEP = 1e-5  # of a side


def place_slopes(
    field: Callable[[FloatArray], FloatArray], places: FloatArray, sides: FloatArray
) -> FloatArray:
    """Derivatives [1/m] of a field by x and y of points or footprints (n, 2 or 3), (n, 2, ...).

    field: from places (m, 2 or 3) to (m, ...); sides (2,): of the plate.
    """
    at = places[:, None, :2]
    step = STEP * sides
    is_inner = np.minimum(at, sides - at)[:, 0] >= step
    inwards = np.where(at[:, 0] > sides / 2, -1.0, 1.0)
    # Steps to two further points, and what they and the point itself count, (n, 2) each.
    first, second = np.where(is_inner, 1.0, inwards), np.where(is_inner, -1.0, 2 * inwards)
    own = np.where(is_inner, 0.0, -1.5 * inwards)
    counts = own, np.where(is_inner, 0.5, 2 * inwards), np.where(is_inner, -0.5, -0.5 * inwards)
    moved = np.repeat(places[:, None], 4, axis=1)  # along x, along y, then further
    for number, steps in enumerate((first, second)):
        for axis in range(2):
            moved[:, 2 * number + axis, axis] += steps[:, axis] * step[axis]
    every = np.concatenate([places[:, None], moved], axis=1)
    found = field(every.reshape(-1, places.shape[1]))
    found = found.reshape(len(places), 5, *found.shape[1:])
    weights = np.array(counts) / step  # (3, n, 2)
    weights = weights.reshape(*weights.shape, *[1] * (found.ndim - 2))
    taken = found[:, [[0, 0], [1, 2], [3, 4]]].swapaxes(0, 1)  # (3, n, 2, ...)
    return np.asarray((weights * taken).sum(axis=0))
