"""Modes of a surface that were read, in place of those of a plate that are solved.

Modes above the cut-off are truncated ones that are known. What lies above the last mode is a
compliance that is estimated from the number and the size of the upper half of the modes:

    R(p, q) = n sqrt(m(p) m(q)) c(k |p - q|) / (4 pi² f),   c(r) = 2 int_1^inf J0(r x) / x³ dx

with n modes per Hz at the last frequency f, m their mean square at a point and k their wavenumber.
It is what a homogeneous plate with these modes adds. Residual vectors that a program exports as
modes are truncated modes like others.
"""

import math
from copy import copy
from functools import cache

import numpy as np

from model.arrays import FloatArray
from model.structure.attachments import check_on_plate, mean_over
from model.structure.modal_elasticity import Dispersion
from model.structure.plate import Plate
from model.structure.surface import LEAST_KNOWN, THICKNESS, Surface, surface_shapes

RESIDUAL_ORDER = 4
"""Residual vectors of each point.

A field has this many terms, a receptance between points twice as many, from inner products.
"""

_MAX_NODES = 2500  # through which splines go; finer meshes are thinned
_MAX_CACHED = 8
_TRUNCATED = 0.75  # of the highest frequency: modes above it are not kept but summed
_UNCERTAIN = 1 / 3  # of the estimated compliance; see docs/how-to/surface.md
_OF_A_DISC = 0.7  # mean distance of its points from the middle, in radii


@cache
def _correlation() -> tuple[FloatArray, FloatArray]:
    """Arguments r and c(r)."""
    from scipy.special import j0

    r = np.linspace(0, 40, 2001)
    t, weights = np.polynomial.legendre.leggauss(800)
    t, weights = (t + 1) / 2, weights / 2
    return r, 2 * (j0(r[:, None] / t) * t) @ weights


def thinned(points: FloatArray, count: int) -> FloatArray:
    """Numbers of at most so many points (n, 2), evenly over the surface; equal places once."""
    _, first = np.unique(np.round(points / (1e-6 * np.ptp(points))), axis=0, return_index=True)
    size = math.sqrt(float(np.prod(np.ptp(points, axis=0))) / count)
    while len(first) > count:
        cells = np.floor(points[first] / size).astype(int)
        _, own = np.unique(cells, axis=0, return_index=True)
        if len(own) <= count:
            first = first[own]
        size *= 1.05
    return np.sort(first)


class SurfaceModes:
    """Modes of a surface below a cut-off; see `FreeModes`.

    plate: that stands for it; one that is thicker or stiffer has all of its modes scaled. shift
    [rad²/s²]: of the order of the lowest modes.
    """

    def __init__(
        self,
        plate: Plate,
        surface: Surface,
        *,
        shift: float,
        cutoff_frequency: float,
        frequency_max: float,
    ) -> None:
        from scipy.interpolate import RBFInterpolator

        read = surface_shapes(surface.file, surface.digest, surface.normal)
        thicker = plate.thickness / THICKNESS
        faster = surface.frequency_factor(plate.thickness, plate.material.E)
        frequencies = faster * read.frequencies
        highest = float(frequencies[-1])
        cut = min(cutoff_frequency, max(LEAST_KNOWN * frequency_max, _TRUNCATED * highest))
        # One is left to be truncated, since sums over these need some.
        self._kept = min(int(np.searchsorted(frequencies, cut)), len(frequencies) - 1)
        eigenvalues = (2 * math.pi * frequencies) ** 2
        self.eigenvalues = eigenvalues[: self._kept]
        self.losses = np.zeros(self._kept)
        self.dispersion: Dispersion | None = None
        u = 1 / (eigenvalues[self._kept :] + shift)
        self.largest_truncated = float(u.max())
        self._powers = (u / u.max()) ** np.arange(1, 2 * RESIDUAL_ORDER + 1)[:, None]
        chosen = thinned(read.points, _MAX_NODES)
        shapes = read.shapes[chosen] / math.sqrt(thicker)
        self._spline = RBFInterpolator(read.points[chosen], shapes, kernel="cubic", degree=2)
        self._sides = plate.length, plate.width
        self._upper = slice(read.rigid + (len(frequencies) - read.rigid) // 2, None)
        upper = frequencies[self._upper]
        per_hertz = len(upper) / (highest - upper[0] + 1e-9)
        self._size = per_hertz / (4 * math.pi**2 * highest)
        area = math.prod(self._sides)
        self._wavenumber = math.sqrt(4 * math.pi * highest * per_hertz / area)
        self._softness = 1.0
        self._known: dict[tuple[tuple[int, ...], bytes], FloatArray] = {}

    def softer(self) -> "SurfaceModes":
        """The surface with as much less of the estimated compliance as that is uncertain."""
        found = copy(self)
        found._softness = 1 - _UNCERTAIN
        return found

    def shapes_at(self, points: FloatArray) -> FloatArray:
        """Mode shapes at points [m] (p, 2) or footprints (p, 3), (p, r)."""
        return self._observe(points)[:, : self._kept]

    def truncated_terms(self, points: FloatArray, others: FloatArray) -> FloatArray:
        """Sums between points (n, 2) and others (m, 2)."""
        own, other = (self._observe(each)[:, self._kept :] for each in (points, others))
        terms = (own * self._powers[:, None]) @ other.T
        terms[0] += self._local(points, others)
        return np.asarray(terms)

    def basis(self, points: FloatArray, others: FloatArray) -> FloatArray:
        """Deflection at others of modes and residual vectors, (m, r + RESIDUAL_ORDER n)."""
        at = self._observe(others)
        extra = self._residuals(points) @ at[:, self._kept :].T
        extra[: len(np.atleast_2d(points))] += self._local(points, others)
        return np.hstack([at[:, : self._kept], extra.T])

    def unknowns(self, points: FloatArray) -> tuple[FloatArray, ...]:
        """The columns of `basis` in modes, without the estimated compliance, in one part."""
        residuals = self._residuals(points)
        count = self._kept
        found = np.zeros((count + residuals.shape[1], count + len(residuals)))
        found[:count, :count] = np.eye(count)
        found[count:, count:] = residuals.T
        return (found,)

    def _residuals(self, points: FloatArray) -> FloatArray:
        """Residual vectors in truncated modes, term by term, (RESIDUAL_ORDER n, t)."""
        truncated = self._observe(points)[:, self._kept :]
        return np.concatenate(truncated * self._powers[:RESIDUAL_ORDER, None])

    def _local(self, points: FloatArray, others: FloatArray) -> FloatArray:
        """Estimated compliance in modes that are not known, in units of u_c, (n, m)."""
        own, other = np.atleast_2d(points), np.atleast_2d(others)
        sizes = [
            np.sqrt((self._observe(each)[:, self._upper] ** 2).mean(axis=1))
            for each in (own, other)
        ]
        apart = np.linalg.norm(own[:, None, :2] - other[None, :, :2], axis=2)
        if own.shape[1] == other.shape[1] == 3:  # a disc yields less than a point
            apart = np.hypot(apart, _OF_A_DISC * np.maximum(own[:, None, 2], other[None, :, 2]))
        correlation = np.interp(self._wavenumber * apart, *_correlation(), right=0.0)
        found = self._softness * self._size * np.outer(*sizes) * correlation
        return np.asarray(found / self.largest_truncated)

    def _observe(self, points: FloatArray) -> FloatArray:
        """Shapes of all modes at points or footprints of the surface, cached."""
        points = np.atleast_2d(np.asarray(points, dtype=float))
        key = points.shape, points.tobytes()
        if key not in self._known:
            length, width = self._sides
            check_on_plate(points, length=length, width=width)
            found = mean_over(self._spline, points, length=length, width=width)
            while len(self._known) >= _MAX_CACHED:
                self._known.pop(next(iter(self._known)))
            self._known[key] = np.asarray(found)
        return self._known[key]
