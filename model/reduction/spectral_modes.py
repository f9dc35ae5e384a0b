"""Modes of the free plate in Legendre polynomials, and its truncated ones between any points.

The residual vectors of all polynomials of the deflection are solved once; those of a force at any
point are then a product with the polynomials there, and so are the sums over truncated modes.
"""

import math
from functools import cached_property

import numpy as np

from model.arrays import FloatArray
from model.fem.symmetry import CLASSES
from model.reduction.free_modes import RESIDUAL_ORDER, PointSolutions
from model.spectral.local_compliance import local_compliance
from model.spectral.mesh import SpectralMesh
from model.spectral.modes import SpectralClass, solve_class
from model.structure.footprint import check_on_plate
from model.structure.plate import Plate

_MAX_CACHED = 4  # sets of points whose polynomials are kept


class SpectralModes:
    """Modes of a free plate in the functions of a spectral mesh; see `FreeModes`."""

    def __init__(
        self, plate: Plate, mesh: SpectralMesh, classes: tuple[SpectralClass, ...]
    ) -> None:
        self._plate = plate
        self._mesh = mesh
        self._classes = classes
        self.eigenvalues = np.concatenate([part.eigenvalues for part in classes])
        self.largest_truncated = max(part.largest_truncated for part in classes)
        self._known: dict[bytes, tuple[FloatArray, ...]] = {}

    def solve_at(self, points: FloatArray) -> PointSolutions:
        """Solve for forces at points [m] (n, 2)."""
        at = self._deflections(points)
        shapes = [own @ part.vectors[: part.deflections] for own, part in self._by_class(at)]
        residuals = tuple(
            np.moveaxis(operator[:RESIDUAL_ORDER] @ own.T, 2, 0)
            for own, operator in zip(at, self._operators, strict=True)
        )
        return PointSolutions(
            points, np.hstack(shapes), residuals, self.truncated_terms(points, points)
        )

    def truncated_terms(self, points: FloatArray, others: FloatArray) -> FloatArray:
        """Sums between points (n, 2) and others (m, 2), as in `PointSolutions`."""
        truncated_terms = np.zeros((2 * RESIDUAL_ORDER, len(points), len(others)))
        pairs = zip(self._deflections(points), self._deflections(others), strict=True)
        for (own, other), operator in zip(pairs, self._operators, strict=True):
            truncated_terms += own @ operator @ other.T
        truncated_terms[0] += self._local(points, others)
        return truncated_terms

    def basis(self, attached: PointSolutions, points: FloatArray) -> FloatArray:
        """Deflection at points of modes and residual vectors, (p, r + RESIDUAL_ORDER n)."""
        at = self._deflections(points)
        count = len(attached.points)
        shapes = [own @ part.vectors[: part.deflections] for own, part in self._by_class(at)]
        extra = np.zeros((len(points), RESIDUAL_ORDER * count))
        for own, residual in zip(at, attached.residuals, strict=True):
            extra += own @ residual.transpose(2, 1, 0).reshape(own.shape[1], -1 if count else 0)
        extra[:, :count] += self._local(points, attached.points)
        return np.hstack([*shapes, extra])

    def _by_class(self, at: tuple[FloatArray, ...]) -> "zip[tuple[FloatArray, SpectralClass]]":
        return zip(at, self._classes, strict=True)

    def _local(self, points: FloatArray, others: FloatArray) -> FloatArray:
        """Compliance in waves that the polynomials do not resolve, in units of u_c."""
        degrees = (self._mesh.nx, self._mesh.ny)
        missing = local_compliance(self._plate, degrees, points, others)
        return missing / self.largest_truncated

    @cached_property
    def _operators(self) -> tuple[FloatArray, ...]:
        """Residual operators between the polynomials, by class (2 RESIDUAL_ORDER, m, m)."""
        return tuple(
            part.residual_operators(terms=2 * RESIDUAL_ORDER, scale=self.largest_truncated)
            for part in self._classes
        )

    def _deflections(self, points: FloatArray) -> tuple[FloatArray, ...]:
        """Polynomials of the deflection at points or footprints on the plate, by class (p, m)."""
        points = np.atleast_2d(np.asarray(points, dtype=float))
        key = points.tobytes()
        if key not in self._known:
            check_on_plate(points, length=self._mesh.length, width=self._mesh.width)
            if len(self._known) >= _MAX_CACHED:
                self._known.pop(next(iter(self._known)))
            self._known[key] = tuple(part.deflection_at(points) for part in self._classes)
        return self._known[key]


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
