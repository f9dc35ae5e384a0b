"""Contribution of the truncated modes at points of attachment, solved on demand and cached."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import sparse

from model.arrays import FloatArray
from model.fem.mesh import Mesh
from model.reduction.class_modes import ClassModes

TERMS = 4
"""Solves for each point.

A field has this many terms, a receptance between attachments twice as many, from inner products.
"""

MAX_CACHE_BYTES = 512 << 20
"""Memory for solved points; beyond it the oldest are dropped."""

MAX_CACHED_RASTERS = 4
"""Sets of observed points whose interpolation is cached."""


@dataclass(frozen=True, eq=False)
class Attachments:
    """Points where forces act on a free plate, with their residual vectors.

    shapes: (n, r) of the modes; residuals: by symmetry class, (n, TERMS, size); moments: (2 TERMS,
    n, n) receptances of all truncated modes together with their u / u_c to the power 1, 2, ...
    """

    shapes: FloatArray
    residuals: tuple[FloatArray, ...]
    moments: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class _Solved:
    """One point in one class: its force (size,), and sums of phi (u / u_c)^j, (TERMS, size).

    mass_weighted: the same sums times the mass.
    """

    force: FloatArray
    residual: FloatArray
    mass_weighted: FloatArray


class AttachmentSolver:
    """Solver for points of attachment on one plate, with a cache.

    scale: u_c, 1 / (lambda + shift) of the lowest truncated mode [s²/rad²].
    """

    def __init__(self, mesh: Mesh, classes: Sequence[ClassModes], *, scale: float) -> None:
        self._mesh = mesh
        self._classes = tuple(classes)
        self._scale = scale
        self._solved: dict[tuple[float, float], tuple[_Solved, ...]] = {}
        self._observed: dict[bytes, tuple[FloatArray, tuple[sparse.csr_array, ...]]] = {}

    def solve(self, points: FloatArray) -> Attachments:
        """Solve for forces at points [m] (n, 2), from the cache where possible."""
        known = self._solutions(points)
        shapes = [
            np.array([each[number].force for each in known]).reshape(len(known), -1) @ part.vectors
            for number, part in enumerate(self._classes)
        ]
        residuals = tuple(
            np.array([each[number].residual for each in known]).reshape(
                len(known), TERMS, part.symmetry.size
            )
            for number, part in enumerate(self._classes)
        )
        moments = self._between(known, known)
        self._trim_cache()
        return Attachments(np.hstack(shapes), residuals, moments)

    def moments(self, points: FloatArray, others: FloatArray) -> FloatArray:
        """Moments between points (n, 2) and others (m, 2), (2 TERMS, n, m)."""
        return self._between(self._solutions(points), self._solutions(others))

    def _solutions(self, points: FloatArray) -> "list[tuple[_Solved, ...]]":
        """Solutions for points [m] (n, 2), by point and class."""
        keys = [(float(x), float(y)) for x, y in np.asarray(points, dtype=float).reshape(-1, 2)]
        unknown = [key for key in dict.fromkeys(keys) if key not in self._solved]
        if unknown:
            self._solve_for(unknown)
        return [self._solved[key] for key in keys]

    def _between(
        self, points: "list[tuple[_Solved, ...]]", others: "list[tuple[_Solved, ...]]"
    ) -> FloatArray:
        rows, columns = len(points), len(others)
        moments = np.zeros((2 * TERMS, rows, columns))
        for number, part in enumerate(self._classes):
            size = part.symmetry.size
            force = np.array([each[number].force for each in points]).reshape(rows, size)
            residual = np.array([each[number].residual for each in points]).reshape(-1, size)
            mass_weighted = np.array([each[number].mass_weighted for each in others]).reshape(
                -1, size
            )
            first = np.array([each[number].residual[0] for each in others]).reshape(columns, size)
            moments[0] += force @ first.T
            inner = (residual @ mass_weighted.T).reshape(rows, TERMS, columns, TERMS)
            for power in range(2, 2 * TERMS + 1):
                moments[power - 1] += inner[:, power // 2 - 1, :, (power + 1) // 2 - 1]
        return moments

    def basis(self, attached: Attachments, points: FloatArray) -> FloatArray:
        """Deflection at points of modes and residual vectors, (p, r + TERMS n).

        Residual vectors come term by term, each for all attachments.
        """
        shapes, maps = self._observe(np.asarray(points, dtype=float))
        extra = np.zeros((len(shapes), TERMS * len(attached.shapes)))
        for each, residual in zip(maps, attached.residuals, strict=True):
            extra += each @ residual.transpose(2, 1, 0).reshape(residual.shape[2], -1)
        return np.hstack([shapes, extra])

    def _observe(self, points: FloatArray) -> tuple[FloatArray, tuple[sparse.csr_array, ...]]:
        """Mode shapes at points (p, r), and by class the map to deflections there; cached."""
        key = points.tobytes()
        if key not in self._observed:
            interpolation = self._mesh.interpolation(points)
            maps = tuple(
                sparse.csr_array(interpolation @ part.symmetry.expansion) for part in self._classes
            )
            pairs = zip(maps, self._classes, strict=True)
            shapes = np.hstack([each @ part.vectors for each, part in pairs])
            if len(self._observed) >= MAX_CACHED_RASTERS:
                self._observed.clear()
            self._observed[key] = shapes, maps
        return self._observed[key]

    def _solve_for(self, points: list[tuple[float, float]]) -> None:
        interpolation = self._mesh.interpolation(np.array(points))
        forces = [(interpolation @ part.symmetry.expansion).toarray() for part in self._classes]
        solved = [
            part.residuals(force, terms=TERMS, scale=self._scale)
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
        size = 8 * (2 * TERMS + 1) * sum(part.symmetry.size for part in self._classes)
        while len(self._solved) * size > MAX_CACHE_BYTES:
            del self._solved[next(iter(self._solved))]
