"""A regular raster over the plate, with interpolation of fields between its points.

Lagrange polynomials over six points (quintic) at a spacing of a twentieth of the shortest bending
wavelength interpolate a field within 1e-4. The points of a fingertip are then one small matrix
product, whatever the mesh.
"""

import math
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np

from model.arrays import Float32Array, FloatArray, IntArray, lattice
from model.errors import InputError
from model.finger import FINGERTIP_RADIUS, FIVE_AND_FINE, FIVE_POINTS, fingertips_on
from model.structure.attachments import mean_over
from model.structure.plate import Plate

POINTS_PER_WAVELENGTH = 20
MAX_SPACING, MIN_SPACING = 0.008, 0.003  # m
PATCH = 6  # points along a side of an interpolation, at least
FEW = len(FIVE_POINTS.points)


@dataclass(frozen=True)
class Raster:
    """nx by ny points over length by width [m], the edges included; numbered along x first."""

    nx: int
    ny: int
    length: float
    width: float

    def __post_init__(self) -> None:
        """Check the number of points."""
        if not (PATCH <= self.nx <= 5000 and PATCH <= self.ny <= 5000):
            raise InputError(
                f"raster must have {PATCH} to 5000 points a side, got {self.nx}x{self.ny}"
            )

    @classmethod
    def for_plate(cls, plate: Plate, *, frequency_max: float) -> "Raster":
        """Raster for bending waves up to a frequency [Hz]."""
        wanted = plate.bending_wavelength(frequency_max) / POINTS_PER_WAVELENGTH
        spacing = min(max(wanted, MIN_SPACING), MAX_SPACING)
        nx, ny = (max(PATCH, math.ceil(side / spacing) + 1) for side in (plate.length, plate.width))
        return cls(nx, ny, plate.length, plate.width)

    @property
    def point_count(self) -> int:
        """Number of points."""
        return self.nx * self.ny

    @cached_property
    def x(self) -> FloatArray:
        """Positions of the columns [m], (nx,)."""
        return np.linspace(0, self.length, self.nx)

    @cached_property
    def y(self) -> FloatArray:
        """Positions of the rows [m], (ny,)."""
        return np.linspace(0, self.width, self.ny)

    @cached_property
    def points(self) -> FloatArray:
        """Positions [m], (point_count, 2)."""
        return lattice(self.x, self.y)

    def fingertips(self, centres: FloatArray, values: Float32Array) -> "FingertipShapes":
        """Values (point_count, r) at the fingertips centred at (k, 2) [m] on the plate."""
        points, weights = fingertips_on(
            centres, length=self.length, width=self.width, rule=FIVE_AND_FINE
        )
        index, interpolation = self._patches(centres, points)
        found = interpolation @ values.take(index, axis=0)
        few, fine = weights.astype(np.float32)
        return FingertipShapes(
            np.ascontiguousarray(found[:, :FEW]),
            np.ascontiguousarray(found[:, FEW:]),
            few[:, :FEW],
            fine[:, FEW:],
        )

    def at(self, values: Float32Array, points: FloatArray) -> Float32Array:
        """Values (point_count, c) at points [m] (n, 2) of the plate: (n, c).

        At footprints (n, 3) their means.
        """
        if points.shape[1] == 3:
            each = partial(self.at, values)
            return mean_over(each, points, length=self.length, width=self.width).astype(np.float32)
        index, weights = self._patches(points, points[:, None, :])
        return np.asarray((weights @ values[index])[:, 0])

    @cached_property
    def patch(self) -> tuple[int, int]:
        """Points along the sides of a patch that holds a fingertip."""
        count, spacing = self._points
        wide = np.ceil(2 * FINGERTIP_RADIUS / spacing).astype(int) + 2
        side_x, side_y = np.minimum(np.maximum(PATCH, wide), count).tolist()
        return side_x, side_y

    @cached_property
    def _points(self) -> tuple[IntArray, FloatArray]:
        """Number of points along x and y, and their spacing [m]."""
        count = np.array([self.nx, self.ny])
        return count, np.array([self.length, self.width]) / (count - 1)

    @cached_property
    def _side(self) -> IntArray:
        """The same of a patch."""
        return np.array(self.patch)

    @cached_property
    def _patch_index(self) -> IntArray:
        """Numbers of a patch's points, counted from its lowest, (patch,)."""
        side_x, side_y = self.patch
        return np.asarray((np.arange(side_y)[:, None] * self.nx + np.arange(side_x)).ravel())

    @cached_property
    def _lagrange(self) -> FloatArray:
        """Coefficients of a patch's Lagrange polynomials along x and y, for powers of -1..1.

        (2, 1, powers, powers); the shorter side's have zeros beside them.
        """
        side = self.patch
        found = np.zeros((2, 1, max(side), max(side)))
        for axis, count in enumerate(side):
            powers = np.vander(np.linspace(-1, 1, count), increasing=True)
            found[axis, 0, :count, :count] = np.linalg.inv(powers)
        return found

    def _patches(self, centres: FloatArray, points: FloatArray) -> tuple[IntArray, Float32Array]:
        """Raster points around centres (k, 2), and their weights at points (k, p, 2) nearby.

        (k, patch) and (k, p, patch).
        """
        (count, spacing), side = self._points, self._side
        start = np.rint(centres / spacing - (side - 1) / 2).astype(int)
        start = np.minimum(np.maximum(start, 0), count - side)
        local = (points / spacing - start[:, None]) * (2 / (side - 1)) - 1
        powers = np.vander(local.transpose(2, 0, 1).ravel(), max(side), increasing=True)
        along = powers.reshape(2, *points.shape[:2], -1) @ self._lagrange
        along_x, along_y = along.astype(np.float32)
        weights = along_y[:, :, : side[1], None] * along_x[:, :, None, : side[0]]
        index = (start[:, 1] * self.nx + start[:, 0])[:, None] + self._patch_index
        return index, weights.reshape(*points.shape[:2], -1)


@dataclass(frozen=True, eq=False)
class FingertipShapes:
    """Shapes (k, p, r) under k fingertips and weights (k, p) of the points in the mean over each.

    At few points for searches and at fine ones for figures; the centre comes first.
    """

    few: Float32Array
    fine: Float32Array
    few_weights: Float32Array
    fine_weights: Float32Array
