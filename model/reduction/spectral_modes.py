"""Modes of the free plate in Legendre polynomials, and its truncated ones between any points.

The residual vectors of the points of the first layout are solved for alone. For a second one those
of all polynomials of the deflection are: the residual vectors of a force at any point are then a
product with the polynomials there, and so are the sums over truncated modes. With many polynomials,
where that takes much longer than modes and layouts together, the first few are solved alone.
"""

import math
from dataclasses import dataclass

import numpy as np

from model.arrays import FloatArray
from model.fem.symmetry import CLASSES
from model.reduction.free_modes import RESIDUAL_ORDER, CacheKey, PointSolutions, unknowns_of
from model.spectral.local_compliance import (
    Unresolved,
    compliance_between,
    uncertain_compliance,
    unresolved_at,
)
from model.spectral.mesh import SpectralMesh
from model.spectral.modes import SpectralClass, deflections_by_class, solve_class
from model.structure.dispersion import Dispersion
from model.structure.footprint import check_on_plate
from model.structure.plate import Plate

_MAX_CACHED = 4  # sets of points whose polynomials are kept
_PER_POINT = 50  # polynomials of a class for each point that is solved alone


@dataclass(frozen=True, eq=False)
class _Observed:
    """At p points: deflections by class, each (p, m), shapes (p, r), unresolved compliance."""

    deflections: tuple[FloatArray, ...]
    shapes: FloatArray
    unresolved: Unresolved


class SpectralModes:
    """Modes of a free plate in the functions of a spectral mesh; see `FreeModes`."""

    def __init__(
        self, plate: Plate, mesh: SpectralMesh, classes: tuple[SpectralClass, ...]
    ) -> None:
        self._plate = plate
        self._mesh = mesh
        self._directions = mesh.directions(plate)
        self._classes = classes
        self.eigenvalues = np.concatenate([part.eigenvalues for part in classes])
        self.losses = np.zeros(len(self.eigenvalues))
        self.dispersion: Dispersion | None = None
        self.largest_truncated = max(part.largest_truncated for part in classes)
        self._first: PointSolutions | None = None
        self._alone_count = 0
        self._operators: tuple[FloatArray, ...] | None = None
        self._known: dict[CacheKey, _Observed] = {}

    def solve_at(self, points: FloatArray) -> PointSolutions:
        """Solve for forces at points [m] (n, 2)."""
        at = self._observe(points)
        if self._first is None:
            self._first = self._solve_alone(points, at)
        if np.array_equal(self._first.points, points):
            return self._first
        if self._is_solved_alone(len(points)):
            return self._solve_alone(points, at)
        residuals = tuple(
            np.moveaxis(operator[:RESIDUAL_ORDER] @ own.T, 2, 0)
            for own, operator in zip(at.deflections, self._solved_operators(), strict=True)
        )
        return PointSolutions(points, at.shapes, residuals, self.truncated_terms(points, points))

    def shapes_at(self, points: FloatArray) -> FloatArray:
        """Mode shapes at points [m] (p, 2) or footprints (p, 3), (p, r)."""
        return self._observe(points).shapes

    def truncated_terms(self, points: FloatArray, others: FloatArray) -> FloatArray:
        """Sums between points (n, 2) and others (m, 2), as in `PointSolutions`."""
        if self._is_solved_alone(len(points) + len(others)):
            both = np.vstack([points, others])
            solved = self._solve_alone(both, self._observe(both))
            return solved.truncated_terms[:, : len(points), len(points) :]
        own, other = self._observe(points), self._observe(others)
        truncated_terms = np.zeros((2 * RESIDUAL_ORDER, len(points), len(others)))
        pairs = zip(own.deflections, other.deflections, self._solved_operators(), strict=True)
        for left, right, operator in pairs:
            truncated_terms += left @ operator @ right.T
        truncated_terms[0] += self._local(own, other)
        return truncated_terms

    def basis(self, attached: PointSolutions, points: FloatArray) -> FloatArray:
        """Deflection at points of modes and residual vectors, (p, r + RESIDUAL_ORDER n)."""
        at = self._observe(points)
        count, modes = len(attached.points), len(self.eigenvalues)
        basis = np.zeros((len(points), modes + RESIDUAL_ORDER * count))
        basis[:, :modes] = at.shapes
        extra = basis[:, modes:]
        for own, residual in zip(at.deflections, attached.residuals, strict=True):
            extra += own @ residual.transpose(2, 1, 0).reshape(own.shape[1], -1 if count else 0)
        extra[:, :count] += self._local(at, self._observe(attached.points))
        return basis

    def unknowns(self, attached: PointSolutions) -> tuple[FloatArray, ...]:
        """The columns of `basis` by symmetry class, without the local compliance."""
        modes = [part.vectors[: part.deflections] for part in self._classes]
        density = self._plate.material.rho * self._plate.thickness
        return tuple(each / math.sqrt(density) for each in unknowns_of(modes, attached.residuals))

    def uncertain(self, points: FloatArray, others: FloatArray) -> FloatArray:
        """By how much `truncated_terms` of the first power may be too low, (n, m)."""
        own, other = self._observe(points), self._observe(others)
        return uncertain_compliance(self._plate, own.unresolved, other.unresolved) / (
            self.largest_truncated
        )

    def _is_solved_alone(self, count: int) -> bool:
        """Whether so many further points take less without the operators."""
        max_alone = max(part.deflections for part in self._classes) // _PER_POINT
        return self._operators is None and self._alone_count + count <= max_alone

    def _solve_alone(self, points: FloatArray, at: _Observed) -> PointSolutions:
        """Solve for these points, without the operators."""
        self._alone_count += len(points)
        residuals = []
        truncated_terms = np.zeros((2 * RESIDUAL_ORDER, len(points), len(points)))
        for own, part in zip(at.deflections, self._classes, strict=True):
            solved = part.residuals(own, terms=RESIDUAL_ORDER, scale=self.largest_truncated)
            deflection = solved[:, :, : own.shape[1]]
            truncated_terms += _sums(solved, own @ deflection[0].T)
            residuals.append(deflection.swapaxes(0, 1))
        truncated_terms[0] += self._local(at, at)
        return PointSolutions(points, at.shapes, tuple(residuals), truncated_terms)

    def _solved_operators(self) -> tuple[FloatArray, ...]:
        """Residual operators between the polynomials, by class (2 RESIDUAL_ORDER, m, m)."""
        if self._operators is None:
            operators = []
            for part in self._classes:
                unit = np.eye(part.deflections)
                solved = part.residuals(unit, terms=RESIDUAL_ORDER, scale=self.largest_truncated)
                operators.append(_sums(solved, solved[0, :, : part.deflections]))
            self._operators = tuple(operators)
        return self._operators

    def _local(self, own: _Observed, other: _Observed) -> FloatArray:
        """Compliance in waves that the polynomials do not resolve, in units of u_c."""
        missing = compliance_between(self._plate, own.unresolved, other.unresolved)
        return missing / self.largest_truncated

    def _observe(self, points: FloatArray) -> _Observed:
        """What is known of points or footprints on the plate, cached."""
        points = np.atleast_2d(np.asarray(points, dtype=float))
        key = points.shape, points.tobytes()
        if key not in self._known:
            check_on_plate(points, length=self._mesh.length, width=self._mesh.width)
            if len(self._known) >= _MAX_CACHED:
                self._known.pop(next(iter(self._known)))
            deflections = deflections_by_class(self._plate, *self._directions, points)
            pairs = zip(deflections, self._classes, strict=True)
            self._known[key] = _Observed(
                deflections,
                np.hstack([own @ part.vectors[: part.deflections] for own, part in pairs]),
                unresolved_at(self._plate, (self._mesh.nx, self._mesh.ny), points),
            )
        return self._known[key]


def _sums(solved: FloatArray, first: FloatArray) -> FloatArray:
    """Sums over the truncated modes between k forces, (2 RESIDUAL_ORDER, k, k).

    solved (RESIDUAL_ORDER, k, n): their residual vectors, of which the sums of powers i + j are
    inner products; first (k, k): that of power one, a product with the forces.
    """
    sums = np.empty((2 * RESIDUAL_ORDER, *first.shape))
    sums[0] = first
    for power in range(2, 2 * RESIDUAL_ORDER + 1):
        sums[power - 1] = solved[power // 2 - 1] @ solved[(power + 1) // 2 - 1].T
    return sums


def spectral_modes(
    plate: Plate, mesh: SpectralMesh, *, shift: float, cutoff_frequency: float
) -> SpectralModes:
    """Solve the four symmetry classes of a free plate for all modes below cutoff_frequency [Hz].

    shift [rad²/s²]: of the factorisations.
    """
    x, y = mesh.directions(plate)
    cut = (2 * math.pi * cutoff_frequency) ** 2
    count = plate.modes_below(cutoff_frequency) // 4 + 4
    return SpectralModes(
        plate,
        mesh,
        tuple(
            solve_class(plate, x, y, parity, shift=shift, cut=cut, count=count)
            for parity in CLASSES
        ),
    )
