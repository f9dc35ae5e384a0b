"""Receptance between attachments and sensors, and its changes by their places."""

from dataclasses import dataclass

import numpy as np

from model.arrays import FloatArray, IntArray
from model.reduction.free_plate import FreePlate
from model.reduction.place_slopes import place_slopes
from model.reduction.receptance import between


@dataclass(frozen=True, eq=False)
class Places:
    """Points of attachment and observation, a of them, of which v may move along x and y.

    footprints (a, 3) [m]; shapes (a, r); products (r + TERMS, a, a): of shapes, then sums over
    truncated modes; slopes (r + TERMS, 2 v,
    a): their derivatives by the place of the first, x and y of one point after the other [1/m].
    """

    footprints: FloatArray
    shapes: FloatArray
    products: FloatArray
    slopes: FloatArray


def places_of(free: FreePlate, footprints: FloatArray, movable: IntArray) -> Places:
    """Solve for footprints (a, 3) [m], of which some (v,), by number, may move."""
    modes = free.modes
    shapes = modes.shapes_at(footprints)
    products = between(modes, footprints, footprints)
    if not len(movable):
        return Places(footprints, shapes, products, np.zeros((len(products), 0, len(footprints))))
    sides = np.array([free.plate.length, free.plate.width])

    def field(points: FloatArray) -> FloatArray:
        return between(modes, points, footprints).swapaxes(0, 1)

    by_place = place_slopes(field, footprints[movable], sides)
    slopes = np.moveaxis(by_place, 2, 0).reshape(len(products), -1, len(footprints))
    return Places(footprints, shapes, products, slopes)
