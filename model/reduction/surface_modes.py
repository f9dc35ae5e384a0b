"""Modes of a surface read from a file, used instead of a plate's solved modes.

Modes above the cut-off are known truncated modes. The compliance of all modes above the last one is
estimated from the number and amplitude of the upper half of the modes, including its higher terms,
without which a reduced plate (`model.reduction.reduced_plate`) could not represent it:

    T_j(p, q) = n f u^j sqrt(m(p) m(q)) c_j(k |p - q|) / (2j - 1),   u = 1 / (4 pi² f²),
    c_j(r) = (4j - 2) int_1^inf J0(r x) / x^(4j - 1) dx,   j = 1, 2, ...

with n modes per Hz and the frequency f up to which as many are expected, both of the straight line
through the natural frequencies by their number, m their mean square at a point and k their
wavenumber. A homogeneous plate with these modes has this compliance. Residual vectors that a
program exports as modes are truncated modes like others.

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
from model.structure.attachments import check_footprints_on_plate, mean_over
from model.structure.modal_elasticity import Dispersion
from model.structure.plate import Plate
from model.structure.surface import LEAST_KNOWN, THICKNESS, Surface, evenly_spaced, surface_shapes

RESIDUAL_ORDER = 4
"""Residual vectors of each point.

A field has this many terms, a receptance between points twice as many, from inner products.
"""

_MAX_NODES = 2500  # through which splines go; finer meshes are thinned
_MAX_CACHED = 8
_TRUNCATED = 0.75  # of the highest frequency: modes above it are not kept but summed
_ALTERNATIVES, _WAVES = 4, 4  # surfaces with other further modes; plane waves in each such mode
_OF_A_DISC = 0.7  # mean distance of its points from the middle, in radii


@cache
def _correlations() -> tuple[FloatArray, FloatArray]:
    """Arguments r (a,) and c_j(r) / (2j - 1) of all terms, (2 RESIDUAL_ORDER, a)."""
    from scipy.special import j0

    r = np.linspace(0, 40, 2001)
    t, weights = np.polynomial.legendre.leggauss(800)
    t, weights = (t + 1) / 2, weights / 2
    orders = np.arange(1, 2 * RESIDUAL_ORDER + 1)
    return r, 2 * (weights * t ** (4 * orders[:, None] - 3)) @ j0(r / t[:, None])


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

        read = surface_shapes(surface.file, surface.digest, surface.normal)
        frequencies = surface.frequency_factor(plate.thickness, plate.material.E) * read.frequencies
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
        chosen = evenly_spaced(read.points, _MAX_NODES)
        sizes = np.full(len(frequencies), math.sqrt(THICKNESS / plate.thickness))
        differing = sizes[read.rigid :][: len(surface.sizes)]
        differing *= surface.sizes[: len(differing)]
        self._spline = RBFInterpolator(
            read.points[chosen],
            read.shapes[chosen] * sizes,
            kernel="cubic",
            degree=2,
        )
        self._sides = {"length": plate.length, "width": plate.width}
        elastic, half = frequencies[read.rigid :], (len(frequencies) - read.rigid) // 2
        self._upper = slice(read.rigid + half, len(frequencies))
        # The straight line through frequencies by number: expected spacing, and where it would end.
        spacing, start = np.polyfit(np.arange(half, len(elastic)) + 0.5, elastic[half:], 1)
        self._spacing = max(float(spacing), 1e-6 * highest)
        self._above = max(start + self._spacing * len(elastic), highest)
        self._shift = shift
        self._waves = np.empty((3, 0, 0))
        self._known: dict[tuple[tuple[int, ...], bytes], FloatArray] = {}

    def alternatives(self) -> Iterator["SurfaceModes"]:
        """Yield surfaces that the known modes may be of, with as many further modes drawn."""
        count = self._upper.stop
        beyond = self._above + self._spacing * (np.arange(count) + 0.5)
        further = 1 / ((2 * math.pi * beyond) ** 2 + self._shift) / self.largest_truncated
        powers = further ** np.arange(1, len(self._powers) + 1)[:, None]
        k = self._wavenumber * np.sqrt(beyond / self._above)
        for seed in range(_ALTERNATIVES):
            rng, found = np.random.default_rng(seed), copy(self)
            direction, phase = rng.uniform(0, 2 * math.pi, (2, _WAVES, count))
            found._waves = np.array([k * np.cos(direction), k * np.sin(direction), phase])
            found._powers = np.hstack([self._powers, powers])
            found._above, found._known = self._above + self._spacing * count, {}
            yield found

    @property
    def _wavenumber(self) -> float:
        """Wavenumber [rad/m] of the first mode that is estimated, of a plate with this density."""
        return math.sqrt(
            4 * math.pi * self._above / self._spacing / math.prod(self._sides.values())
        )

    def shapes_at(self, points: FloatArray) -> FloatArray:
        """Mode shapes at points [m] (p, 2) or footprints (p, 3), (p, r)."""
        return self._observe(points)[:, : self._kept]

    def truncated_terms(self, points: FloatArray, others: FloatArray) -> FloatArray:
        """Sums between points (n, 2) and others (m, 2)."""
        own, other = (self._observe(each)[:, self._kept :] for each in (points, others))
        return np.asarray((own * self._powers[:, None]) @ other.T + self._local(points, others))

    def basis(self, points: FloatArray, others: FloatArray) -> FloatArray:
        """Deflection at others of modes and residual vectors, (m, r + RESIDUAL_ORDER n)."""
        at = self._observe(others)
        extra = self._residuals(points) @ at[:, self._kept :].T
        extra += self._local(points, others)[:RESIDUAL_ORDER].reshape(extra.shape)
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
        """Estimated terms of modes that are not known, as `truncated_terms`, (TERMS, n, m)."""
        own, other = np.atleast_2d(points), np.atleast_2d(others)
        sizes = [self._sizes(self._observe(each)) for each in (own, other)]
        apart = np.linalg.norm(own[:, None, :2] - other[None, :, :2], axis=2)
        if own.shape[1] == other.shape[1] == 3:  # a disc yields less than a point
            apart = np.hypot(apart, _OF_A_DISC * np.maximum(own[:, None, 2], other[None, :, 2]))
        r, by_order = _correlations()
        correlations = np.array(
            [np.interp(self._wavenumber * apart, r, each, right=0.0) for each in by_order]
        )
        u = 1 / ((2 * math.pi * self._above) ** 2 + self._shift) / self.largest_truncated
        powers = u ** np.arange(1, len(by_order) + 1)[:, None, None]
        return np.asarray(powers * (self._above / self._spacing) * np.outer(*sizes) * correlations)

    def _sizes(self, shapes: FloatArray) -> FloatArray:
        """Root mean square of the upper half of the modes at points of shapes (p, r), (p,)."""
        return np.asarray(np.sqrt((shapes[:, self._upper] ** 2).mean(axis=1)))

    def _observe(self, points: FloatArray) -> FloatArray:
        """Shapes of all modes at points or footprints of the surface, drawn ones last, cached."""
        points = np.atleast_2d(np.asarray(points, dtype=float))
        key = points.shape, points.tobytes()
        if key not in self._known:
            check_footprints_on_plate(points, **self._sides)
            found = mean_over(self._spline, points, **self._sides)
            along = np.tensordot(points[:, :2], self._waves[:2], axes=1) + self._waves[2]
            drawn = math.sqrt(2 / _WAVES) * np.cos(along).sum(axis=1)
            while len(self._known) >= _MAX_CACHED:
                self._known.pop(next(iter(self._known)))
            self._known[key] = np.hstack([found, self._sizes(found)[:, None] * drawn])
        return self._known[key]
