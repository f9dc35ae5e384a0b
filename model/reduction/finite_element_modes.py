"""Modes of the free plate on a mesh, and its truncated ones at points, solved on demand."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import sparse

from model.arrays import FloatArray
from model.fem.mesh import Mesh
from model.reduction.class_modes import ClassModes, finite_element_classes
from model.reduction.free_modes import RESIDUAL_ORDER, CacheKey, PointSolutions, unknowns_of
from model.structure.dispersion import Dispersion
from model.structure.footprint import as_footprints
from model.structure.plate import Plate

MAX_CACHE_BYTES = 512 << 20
"""Memory for solved points; beyond it the oldest are dropped."""

MAX_CACHED_RASTERS = 4
"""Sets of observed points whose interpolation is cached."""


@dataclass(frozen=True, slots=True, eq=False)
class _Solved:
    """One point in one class: its force (size,), and residual vectors (RESIDUAL_ORDER, size).

    Those are sums of phi (u / u_c)^j over the truncated modes. mass_weighted: the same sums times
    the mass.
    """

    force: FloatArray
    residual: FloatArray
    mass_weighted: FloatArray


class FiniteElementModes:
    """Modes of a free plate on a mesh, with a cache of solved points; see `FreeModes`."""

    def __init__(self, classes: Sequence[ClassModes]) -> None:
        self._classes = tuple(classes)
        self.eigenvalues = np.concatenate([part.eigenvalues for part in classes])
        self.losses = np.zeros(len(self.eigenvalues))
        self.dispersion: Dispersion | None = None
        self.largest_truncated = max(part.largest_truncated for part in classes)
        self._solved: dict[tuple[float, ...], tuple[_Solved, ...]] = {}
        self._observed: dict[CacheKey, tuple[FloatArray, tuple[sparse.csr_array, ...]]] = {}

    def solve_at(self, points: FloatArray) -> PointSolutions:
        """Solve for forces at points [m] (n, 2), from the cache where possible."""
        known = self._solutions(points)
        shapes = [
            np.array([each[number].force for each in known]).reshape(len(known), -1) @ part.vectors
            for number, part in enumerate(self._classes)
        ]
        residuals = tuple(
            np.array([each[number].residual for each in known]).reshape(
                len(known), RESIDUAL_ORDER, part.size
            )
            for number, part in enumerate(self._classes)
        )
        truncated_terms = self._between(known, known)
        self._trim_cache()
        return PointSolutions(points, np.hstack(shapes), residuals, truncated_terms)

    def shapes_at(self, points: FloatArray) -> FloatArray:
        """Mode shapes at points [m] (p, 2) or footprints (p, 3), (p, r)."""
        shapes, _ = self._observe(np.asarray(points, dtype=float))
        return shapes

    def truncated_terms(self, points: FloatArray, others: FloatArray) -> FloatArray:
        """Sums between points (n, 2) and others (m, 2), as in `PointSolutions`."""
        return self._between(self._solutions(points), self._solutions(others))

    def _solutions(self, points: FloatArray) -> "list[tuple[_Solved, ...]]":
        """Solutions for points [m] (n, 2), by point and class."""
        keys = [tuple(place) for place in as_footprints(points).tolist()]
        unknown = [key for key in dict.fromkeys(keys) if key not in self._solved]
        if unknown:
            self._solve_for(unknown)
        return [self._solved[key] for key in keys]

    def _between(
        self, points: "list[tuple[_Solved, ...]]", others: "list[tuple[_Solved, ...]]"
    ) -> FloatArray:
        rows, columns = len(points), len(others)
        truncated_terms = np.zeros((2 * RESIDUAL_ORDER, rows, columns))
        for number, part in enumerate(self._classes):
            size = part.size
            force = np.array([each[number].force for each in points]).reshape(rows, size)
            residual = np.array([each[number].residual for each in points]).reshape(-1, size)
            mass_weighted = np.array([each[number].mass_weighted for each in others]).reshape(
                -1, size
            )
            first = np.array([each[number].residual[0] for each in others]).reshape(columns, size)
            truncated_terms[0] += force @ first.T
            inner = (residual @ mass_weighted.T).reshape(
                rows, RESIDUAL_ORDER, columns, RESIDUAL_ORDER
            )
            for power in range(2, 2 * RESIDUAL_ORDER + 1):
                truncated_terms[power - 1] += inner[:, power // 2 - 1, :, (power + 1) // 2 - 1]
        return truncated_terms

    def basis(self, attached: PointSolutions, points: FloatArray) -> FloatArray:
        """Deflection at points of modes and residual vectors, (p, r + RESIDUAL_ORDER n).

        Residual vectors come term by term, each for all attachments.
        """
        shapes, maps = self._observe(np.asarray(points, dtype=float))
        extra = np.zeros((len(shapes), RESIDUAL_ORDER * len(attached.shapes)))
        for each, residual in zip(maps, attached.residuals, strict=True):
            extra += each @ residual.transpose(2, 1, 0).reshape(residual.shape[2], -1)
        return np.hstack([shapes, extra])

    def unknowns(self, attached: PointSolutions) -> tuple[FloatArray, ...]:
        """The columns of `basis` by symmetry class."""
        return unknowns_of([part.vectors for part in self._classes], attached.residuals)

    def _observe(self, points: FloatArray) -> tuple[FloatArray, tuple[sparse.csr_array, ...]]:
        """Mode shapes at points (p, r), and by class the map to deflections there; cached."""
        key = points.shape, points.tobytes()
        if key not in self._observed:
            maps = tuple(part.deflection_at(points) for part in self._classes)
            pairs = zip(maps, self._classes, strict=True)
            shapes = np.hstack([each @ part.vectors for each, part in pairs])
            if len(self._observed) >= MAX_CACHED_RASTERS:
                self._observed.clear()
            self._observed[key] = shapes, maps
        return self._observed[key]

    def _solve_for(self, points: list[tuple[float, ...]]) -> None:
        forces = [part.deflection_at(np.array(points)).toarray() for part in self._classes]
        solved = [
            part.residuals(force, terms=RESIDUAL_ORDER, scale=self.largest_truncated)
            for part, force in zip(self._classes, forces, strict=True)
        ]
        for number, point in enumerate(points):
            self._solved[point] = tuple(
                _Solved(
                    force[number].copy(), residual[0, number].copy(), residual[1, number].copy()
                )
                for force, residual in zip(forces, solved, strict=True)
            )

    def _trim_cache(self) -> None:
        """Drop the oldest solved points beyond MAX_CACHE_BYTES."""
        size = 8 * (2 * RESIDUAL_ORDER + 1) * sum(part.size for part in self._classes)
        while len(self._solved) * size > MAX_CACHE_BYTES:
            del self._solved[next(iter(self._solved))]


def finite_element_modes(
    plate: Plate, mesh: Mesh, *, shift: float, cutoff_frequency: float
) -> FiniteElementModes:
    """Solve a free plate on a mesh for all modes below cutoff_frequency [Hz].

    shift [rad²/s²]: of the factorisations.
    """
    return FiniteElementModes(
        finite_element_classes(plate, mesh, shift=shift, cutoff_frequency=cutoff_frequency)
    )
