"""Shapes at points of attachment and observation, and their derivatives by position.

Derivatives by position are second-order differences with a step h, one-sided at edges:

    f' = (f(h) - f(-h)) / 2h,    at an edge: (-3 f(0) + 4 f(h) - f(2h)) / 2h, h pointing inwards.

Closed forms would be simple for polynomials, but a footprint that an edge cuts adds integrals along
that edge, and the compliance of unresolved waves is fitted, with limits near edges. With this step
the differences are right to 1e-6 of the largest derivative, and the rounding of another processor
changes them by 3e-8.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np

from model.arrays import FloatArray, IntArray
from model.reduction.form_modes import ReducedModes
from model.reduction.free_plate import FreeModes

Modes: TypeAlias = FreeModes | ReducedModes
"""Modes of a free plate, or coordinates in which it can have form errors."""

_STEP = 1e-5
"""Step of differences, relative to a side of the plate."""


@dataclass(frozen=True, eq=False)
class AttachmentPoints:
    """Shapes at `a` points of attachment and observation; v points can move along x and y."""

    modes: Modes
    """Modes with these shapes."""
    footprints: FloatArray
    """Position and radius of each (a, 3) [m]."""
    movable: IntArray
    """Indices of the movable points (v,)."""
    shapes: FloatArray
    """Mode shapes (a, r)."""
    truncated: FloatArray
    """Sums over truncated modes (TERMS, a, a)."""
    shape_slopes: FloatArray
    """Derivatives of the shapes by x and y of each movable point in turn (2 v, r) [1/m]."""
    truncated_slopes: FloatArray
    """Derivatives of the sums by the position of the first point (TERMS, 2 v, a) [1/m]."""

    def is_for(self, modes: Modes, movable: IntArray) -> bool:
        """Whether these are shapes of the given modes, with slopes at the given points."""
        return self.modes is modes and np.array_equal(self.movable, movable)

    def moved(self, footprints: FloatArray) -> "AttachmentPoints":
        """The same for other footprints (a, 3), by the slopes of the shapes alone."""
        moves = (footprints - self.footprints)[self.movable, :2].reshape(-1, 2, 1)
        slopes = self.shape_slopes.reshape(len(self.movable), 2, self.shapes.shape[1])
        shapes = self.shapes.copy()
        shapes[self.movable] += (moves * slopes).sum(axis=1)
        return replace(self, footprints=footprints, shapes=shapes)


def places_of(
    modes: Modes, footprints: FloatArray, movable: IntArray, sides: FloatArray
) -> AttachmentPoints:
    """Solve for footprints (a, 3) on a plate with given sides (2,) [m].

    movable (v,): indices of movable footprints.
    """
    moving = footprints[movable]
    shapes = modes.shapes_at(footprints)
    truncated = modes.truncated_terms(footprints, footprints)

    def truncated_at(points: FloatArray) -> FloatArray:
        """Return the truncated sums between points and the footprints, points first."""
        return modes.truncated_terms(points, footprints).swapaxes(0, 1)

    shape_slopes = place_slopes(modes.shapes_at, moving, sides)
    truncated_slopes = np.moveaxis(place_slopes(truncated_at, moving, sides), 2, 0)
    return AttachmentPoints(
        modes=modes,
        footprints=footprints,
        movable=movable,
        shapes=shapes,
        truncated=truncated,
        shape_slopes=shape_slopes.reshape(-1, shapes.shape[1]),
        truncated_slopes=truncated_slopes.reshape(len(truncated), -1, len(footprints)),
    )


def place_slopes(
    field: Callable[[FloatArray], FloatArray], places: FloatArray, sides: FloatArray
) -> FloatArray:
    """Derivatives [1/m] of a field by x and y of points or footprints (n, 2 or 3), (n, 2, ...).

    field: from points (m, 2 or 3) to (m, ...); sides (2,): of the plate.
    """
    positions = places[:, :2]
    step = _STEP * sides
    is_inner = np.minimum(positions, sides - positions) >= step
    inwards = np.where(positions > sides / 2, -1.0, 1.0)
    # Offsets of two neighbors of each point along x and y, in steps, (n, 2).
    first_offset = np.where(is_inner, 1.0, inwards)
    second_offset = np.where(is_inner, -1.0, 2 * inwards)
    stencil = np.repeat(places[:, None], 5, axis=1)  # the point, first neighbors, second neighbors
    for axis in range(2):
        stencil[:, 1 + axis, axis] += first_offset[:, axis] * step[axis]
        stencil[:, 3 + axis, axis] += second_offset[:, axis] * step[axis]
    values = field(stencil.reshape(-1, places.shape[1]))
    values = values.reshape(len(places), 5, *values.shape[1:])
    own_weight = np.where(is_inner, 0.0, -1.5 * inwards) / step
    first_weight = np.where(is_inner, 0.5, 2 * inwards) / step
    second_weight = np.where(is_inner, -0.5, -0.5 * inwards) / step
    column = (len(places), 2, *[1] * (values.ndim - 2))
    slopes = own_weight.reshape(column) * values[:, :1]
    slopes += first_weight.reshape(column) * values[:, 1:3]
    slopes += second_weight.reshape(column) * values[:, 3:]
    return np.asarray(slopes)
