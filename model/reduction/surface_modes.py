"""Modes of a surface read from a file, used instead of a plate's solved modes.

Modes above the cut-off are known truncated modes. The compliance of all modes above the last one is
estimated from the number and amplitude of the upper half of the modes, including its higher terms,
without which a reduced plate (`model.reduction.reduced_plate`) could not represent it:

    T_j(p, q) = n f u^j sqrt(m(p) m(q)) c_j(k |p - q|) / (2j - 1),   u = 1 / (4 pi² f²),
    c_j(r) = (4j - 2) int_1^inf J0(r x) / x^(4j - 1) dx,   j = 1, 2, ...

with n modes per Hz, the frequency f up to which the known modes are expected (both from the
straight line through natural frequencies over mode numbers), the mean square m of the modes at a
point, and their wavenumber k. A homogeneous plate with these modes has this compliance. Residual
vectors that a program exports as modes are treated as truncated modes.

The estimate is a mean. The compliance of a given surface depends on its next modes: for Gaussian
shapes its relative deviation is sqrt(2 / 3N) with N known modes, at each position and in each
symmetry separately, which shifts resonances on stiff ERAs. Its error is therefore estimated from
surfaces whose next modes are drawn: sums of plane waves of the same density, size and wavenumber at
evenly spaced frequencies (`alternatives`).
"""

import math
from collections.abc import Iterator
from copy import copy
from functools import cache

import numpy as np

from model.arrays import FloatArray
from model.reduction.point_cache import PointCache
from model.structure.footprints import check_footprints_on_plate, mean_over
from model.structure.modal_elasticity import Dispersion
from model.structure.plate import Plate
from model.structure.surface import (
    LEAST_KNOWN,
    THICKNESS,
    Surface,
    SurfaceShapes,
    evenly_spaced,
    surface_shapes,
)

RESIDUAL_ORDER = 4
"""Residual vectors of each point.

A field has this many terms, a receptance between points twice as many, from inner products.
"""

_MAX_NODES = 2500  # through which splines go; finer meshes are thinned
_MAX_CACHED = 8
_TRUNCATED = 0.75  # of the highest frequency: modes above it are not kept but summed
_ALTERNATIVES, _WAVES = 4, 4  # surfaces with other further modes; plane waves in each such mode
_MEAN_DISTANCE = 0.7  # of a disc's points from its middle, in radii


@cache
def _correlations() -> tuple[FloatArray, FloatArray]:
    """Arguments r (a,) and c_j(r) / (2j - 1) of all terms, (2 RESIDUAL_ORDER, a)."""
    from scipy.special import j0

    r = np.linspace(0, 40, 2001)
    points, weights = np.polynomial.legendre.leggauss(800)  # over -1 to 1
    t = (points + 1) / 2
    weights = weights / 2
    orders = np.arange(1, 2 * RESIDUAL_ORDER + 1)
    powers = t ** (4 * orders[:, None] - 3)
    return r, 2 * (weights * powers) @ j0(r / t[:, None])


class SurfaceModes:
    """Modes of a surface below a cut-off; see `FreeModes`.

    plate: equivalent plate; a thicker or stiffer one has all modes scaled. shift [rad²/s²]: of the
    order of the lowest modes.
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

        exported = surface_shapes(surface.file, surface.digest, surface.normal)
        scale = surface.frequency_factor(plate.thickness, plate.material.E)
        frequencies = scale * exported.frequencies
        highest = float(frequencies[-1])
        cut = min(cutoff_frequency, max(LEAST_KNOWN * frequency_max, _TRUNCATED * highest))
        # At least one mode is truncated, since sums over the truncated modes need some.
        self._kept = min(int(np.searchsorted(frequencies, cut)), len(frequencies) - 1)
        eigenvalues = (2 * math.pi * frequencies) ** 2
        self.eigenvalues = eigenvalues[: self._kept]
        self.losses = np.zeros(self._kept)
        self.dispersion: Dispersion | None = None
        self._shift = shift
        self.largest_truncated = float(1 / (eigenvalues[self._kept] + shift))
        self._powers = self._powers_at(frequencies[self._kept :])
        self._spline = RBFInterpolator(
            *_interpolated_shapes(exported, surface, plate), kernel="cubic", degree=2
        )
        self._sides = {"length": plate.length, "width": plate.width}
        elastic = frequencies[exported.rigid :]
        half = len(elastic) // 2
        self._upper = slice(exported.rigid + half, len(frequencies))
        # Straight line through frequencies over numbers: expected spacing and highest frequency.
        numbers = np.arange(half, len(elastic)) + 0.5
        slope, start = np.polyfit(numbers, elastic[half:], 1)
        self._spacing = max(float(slope), 1e-6 * highest)
        self._above = max(start + self._spacing * len(elastic), highest)
        self._waves = np.empty((3, 0, 0))
        self._cache = PointCache[FloatArray](_MAX_CACHED)

    def alternatives(self) -> Iterator["SurfaceModes"]:
        """Yield surfaces that can have the known modes, with as many further modes drawn."""
        count = self._upper.stop
        frequencies = self._above + self._spacing * (np.arange(count) + 0.5)
        powers = self._powers_at(frequencies)
        k = self._wavenumber * np.sqrt(frequencies / self._above)
        for seed in range(_ALTERNATIVES):
            rng = np.random.default_rng(seed)
            direction, phase = rng.uniform(0, 2 * math.pi, (2, _WAVES, count))
            alternative = copy(self)
            alternative._waves = np.array([k * np.cos(direction), k * np.sin(direction), phase])
            alternative._powers = np.hstack([self._powers, powers])
            alternative._above = self._above + self._spacing * count
            alternative._cache = PointCache(_MAX_CACHED)
            yield alternative

    def _powers_at(self, frequencies: FloatArray) -> FloatArray:
        """u / u_c of modes at frequencies (n,) [Hz] to the powers 1, 2, ..., (TERMS, n)."""
        u = 1 / ((2 * math.pi * frequencies) ** 2 + self._shift)
        orders = np.arange(1, 2 * RESIDUAL_ORDER + 1)
        return np.asarray((u / self.largest_truncated) ** orders[:, None])

    @property
    def _wavenumber(self) -> float:
        """Wavenumber [rad/m] of the first mode that is estimated, of a plate with this density."""
        area = math.prod(self._sides.values())
        return math.sqrt(4 * math.pi * self._above / self._spacing / area)

    def shapes_at(self, points: FloatArray) -> FloatArray:
        """Mode shapes at points [m] (p, 2) or footprints (p, 3), (p, r)."""
        return self._observe(points)[:, : self._kept]

    def truncated_terms(self, points: FloatArray, receivers: FloatArray) -> FloatArray:
        """Sums between points (n, 2) and receivers (m, 2)."""
        shapes = self._observe(points)[:, self._kept :]
        receiver_shapes = self._observe(receivers)[:, self._kept :]
        terms = (shapes * self._powers[:, None]) @ receiver_shapes.T
        return np.asarray(terms + self._local(points, receivers))

    def basis(self, points: FloatArray, receivers: FloatArray) -> FloatArray:
        """Deflection at receivers of modes and residual vectors, (m, r + RESIDUAL_ORDER n)."""
        shapes = self._observe(receivers)
        residuals = self._residuals(points) @ shapes[:, self._kept :].T
        residuals += self._local(points, receivers)[:RESIDUAL_ORDER].reshape(residuals.shape)
        return np.hstack([shapes[:, : self._kept], residuals.T])

    def unknowns(self, points: FloatArray) -> tuple[FloatArray, ...]:
        """The columns of `basis` in modes, without the estimated compliance, in one part."""
        residuals = self._residuals(points)
        count = self._kept
        columns = np.zeros((count + residuals.shape[1], count + len(residuals)))
        columns[:count, :count] = np.eye(count)
        columns[count:, count:] = residuals.T
        return (columns,)

    def _residuals(self, points: FloatArray) -> FloatArray:
        """Residual vectors in truncated modes, term by term, (RESIDUAL_ORDER n, t)."""
        truncated = self._observe(points)[:, self._kept :]
        return np.concatenate(truncated * self._powers[:RESIDUAL_ORDER, None])

    def _local(self, points: FloatArray, receivers: FloatArray) -> FloatArray:
        """Estimated terms of modes that are not known, as `truncated_terms`, (TERMS, n, m)."""
        points = np.atleast_2d(points)
        receivers = np.atleast_2d(receivers)
        distances = np.linalg.norm(points[:, None, :2] - receivers[None, :, :2], axis=2)
        if points.shape[1] == receivers.shape[1] == 3:  # a disc yields less than a point
            radii = np.maximum(points[:, None, 2], receivers[None, :, 2])
            distances = np.hypot(distances, _MEAN_DISTANCE * radii)
        r, by_order = _correlations()
        arguments = self._wavenumber * distances
        correlations = np.array([np.interp(arguments, r, c, right=0.0) for c in by_order])
        powers = self._powers_at(np.array([self._above]))[:, :, None]
        source_sizes = self._sizes(self._observe(points))
        receiver_sizes = self._sizes(self._observe(receivers))
        sizes = np.outer(source_sizes, receiver_sizes)
        return np.asarray(powers * (self._above / self._spacing) * sizes * correlations)

    def _sizes(self, shapes: FloatArray) -> FloatArray:
        """Root mean square of the upper half of the modes at points of shapes (p, r), (p,)."""
        return np.asarray(np.sqrt((shapes[:, self._upper] ** 2).mean(axis=1)))

    def _observe(self, points: FloatArray) -> FloatArray:
        """Shapes of all modes at points or footprints of the surface, drawn ones last, cached."""
        points = np.atleast_2d(np.asarray(points, dtype=float))
        shapes = self._cache.get(points)
        if shapes is None:
            check_footprints_on_plate(points, **self._sides)
            exported = np.asarray(mean_over(self._spline, points, **self._sides))
            phases = np.tensordot(points[:, :2], self._waves[:2], axes=1) + self._waves[2]
            waves = math.sqrt(2 / _WAVES) * np.cos(phases).sum(axis=1)
            drawn = self._sizes(exported)[:, None] * waves
            shapes = np.hstack([exported, drawn])
            self._cache.put(points, shapes)
        return shapes


def _interpolated_shapes(
    exported: SurfaceShapes, surface: Surface, plate: Plate
) -> tuple[FloatArray, FloatArray]:
    """Return nodes (n, 2) [m] through which splines go, and the shapes (n, r) of all modes there.

    Scaled to the equivalent plate and to the sizes of the first elastic modes, if they are stated.
    """
    nodes = evenly_spaced(exported.points, _MAX_NODES)
    sizes = np.full(len(exported.frequencies), math.sqrt(THICKNESS / plate.thickness))
    stated = sizes[exported.rigid :][: len(surface.sizes)]
    stated *= surface.sizes[: len(stated)]
    return exported.points[nodes], exported.shapes[nodes] * sizes
