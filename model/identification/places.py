"""Shapes and truncated sums at attachments and sensors, and their changes by their places."""

from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np

from model.arrays import FloatArray, IntArray
from model.identification.form_errors import ReducedModes
from model.reduction.free_modes import FreeModes
from model.reduction.place_slopes import place_slopes

Modes: TypeAlias = FreeModes | ReducedModes


@dataclass(frozen=True, eq=False)
class AttachmentPoints:
    """Points of attachment and observation, a of them, of which v may move along x and y.

    footprints (a, 3) [m]; shapes (a, r); truncated (TERMS, a, a): sums over truncated modes;
    shape_slopes (2 v, r), truncated_slopes (TERMS, 2 v, a): their derivatives by the place of the
    first, x and y of one point after the other [1/m].
    """

    footprints: FloatArray
    shapes: FloatArray
    truncated: FloatArray
    shape_slopes: FloatArray
    truncated_slopes: FloatArray

    def moved(self, footprints: FloatArray, movable: IntArray) -> "AttachmentPoints":
        """The same for other footprints (a, 3), by the slopes of the shapes alone."""
        off = (footprints - self.footprints)[movable, :2].reshape(-1, 2, 1)
        slopes = self.shape_slopes.reshape(len(movable), 2, self.shapes.shape[1])
        shapes = self.shapes.copy()
        shapes[movable] += (off * slopes).sum(axis=1)
        return replace(self, footprints=footprints, shapes=shapes)


def places_of(
    modes: Modes, footprints: FloatArray, movable: IntArray, sides: FloatArray
) -> AttachmentPoints:
    """Solve for footprints (a, 3) on a plate of some sides (2,) [m].

    movable (v,): numbers of those that may move.
    """
    moving, shapes = footprints[movable], modes.shapes_at(footprints)
    truncated = modes.truncated_terms(footprints, footprints)
    if not len(movable):
        none = np.zeros((len(truncated), 0, len(footprints)))
        return AttachmentPoints(footprints, shapes, truncated, np.zeros((0, shapes.shape[1])), none)

    def field(points: FloatArray) -> FloatArray:
        return modes.truncated_terms(points, footprints).swapaxes(0, 1)

    by_place = place_slopes(field, moving, sides)
    return AttachmentPoints(
        footprints,
        shapes,
        truncated,
        place_slopes(modes.shapes_at, moving, sides).reshape(-1, shapes.shape[1]),
        np.moveaxis(by_place, 2, 0).reshape(len(truncated), -1, len(footprints)),
    )
