"""Sampling grid of the mode shapes of a plate, and their interpolation between its points.

A patch of points around a position interpolates a field f there. With the points t_k of a patch
along one side scaled to -1 to 1, Lagrange polynomials l_k give

    f(t) = sum_k l_k(t) f(t_k),    l_k(t) = sum_j c_jk t^j,    C = V^-1,    V_kj = t_k^j.

The weight of a point is the product of its polynomials along x and along y. Six points a side
(quintic) at a spacing of a twentieth of the shortest bending wavelength interpolate within 1e-4.
"""

import math
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np

from model.arrays import Float32Array, FloatArray, IntArray, lattice
from model.errors import InputError
from model.finger import FINGERTIP_RADIUS
from model.structure.footprints import mean_over
from model.structure.plate import Plate

POINTS_PER_WAVELENGTH = 20
MAX_SPACING, MIN_SPACING = 0.008, 0.003
"""Bounds of the spacing [m], so that few points span a fingertip and files stay small."""

PATCH = 6
"""Minimum number of points along a side of a patch."""


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
        nx = max(PATCH, math.ceil(plate.length / spacing) + 1)
        ny = max(PATCH, math.ceil(plate.width / spacing) + 1)
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

    @cached_property
    def counts(self) -> IntArray:
        """Number of points along x and y, (2,)."""
        return np.array([self.nx, self.ny])

    @cached_property
    def spacing(self) -> FloatArray:
        """Spacing of the points along x and y [m], (2,)."""
        return np.array([self.length, self.width]) / (self.counts - 1)

    @cached_property
    def patch(self) -> tuple[int, int]:
        """Points along the sides of a patch that holds a fingertip."""
        fingertip = np.ceil(2 * FINGERTIP_RADIUS / self.spacing).astype(int) + 2
        side_x, side_y = np.minimum(np.maximum(PATCH, fingertip), self.counts).tolist()
        return side_x, side_y

    @cached_property
    def _patch_offsets(self) -> IntArray:
        """Numbers of a patch's points, relative to its first point, (patch,)."""
        side_x, side_y = self.patch
        return np.asarray((np.arange(side_y)[:, None] * self.nx + np.arange(side_x)).ravel())

    @cached_property
    def _lagrange(self) -> FloatArray:
        """Coefficients C of a patch's Lagrange polynomials along x and y, (2, 1, powers, powers).

        The coefficients of the shorter side are padded with zeros.
        """
        highest = max(self.patch)
        coefficients = np.zeros((2, 1, highest, highest))
        for axis, count in enumerate(self.patch):
            vandermonde = np.vander(np.linspace(-1, 1, count), increasing=True)
            coefficients[axis, 0, :count, :count] = np.linalg.inv(vandermonde)
        return coefficients

    def patches(self, centers: FloatArray, points: FloatArray) -> tuple[IntArray, Float32Array]:
        """Return raster points around centers (k, 2), and their weights at points (k, p, 2) nearby.

        Numbers (k, patch) and weights (k, p, patch).
        """
        side = np.array(self.patch)
        start = np.rint(centers / self.spacing - (side - 1) / 2).astype(int)
        start = np.minimum(np.maximum(start, 0), self.counts - side)
        t = (points / self.spacing - start[:, None]) * (2 / (side - 1)) - 1
        powers = np.vander(t.transpose(2, 0, 1).ravel(), max(side), increasing=True)
        polynomials = powers.reshape(2, *points.shape[:2], -1) @ self._lagrange
        along_x, along_y = polynomials.astype(np.float32)
        weights = along_y[:, :, : side[1], None] * along_x[:, :, None, : side[0]]
        first = start[:, 1] * self.nx + start[:, 0]
        return first[:, None] + self._patch_offsets, weights.reshape(*points.shape[:2], -1)

    def interpolated(self, values: Float32Array, points: FloatArray) -> Float32Array:
        """Return values (point_count, c) at points [m] (n, 2) of the plate: (n, c).

        At footprints (n, 3), the means over their discs.
        """
        if points.shape[1] == 3:
            interpolate = partial(self.interpolated, values)
            means = mean_over(interpolate, points, length=self.length, width=self.width)
            return means.astype(np.float32)
        numbers, weights = self.patches(points, points[:, None, :])
        return np.asarray((weights @ values[numbers])[:, 0])
