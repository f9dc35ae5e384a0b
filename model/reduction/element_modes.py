"""Modes of a free plate on a mesh of elements; residual vectors represent the truncated ones."""

import math

import numpy as np
from scipy import linalg

from model.arrays import FloatArray
from model.fem import (
    DOF_PER_NODE,
    RIGID_BODY_MODES,
    Mesh,
    PlateMatrices,
    assemble,
    factorize,
    lowest_modes,
)
from model.reduction.point_cache import PointCache
from model.reduction.surface_modes import RESIDUAL_ORDER
from model.structure.modal_elasticity import Dispersion
from model.structure.plate import Plate

_MAX_KEPT_BYTES = 1 << 26  # of residual vectors; residual vectors of a map's raster are not cached
_MAX_CACHED = 4  # sets of points whose residual vectors are kept


class FiniteElementModes:
    """All modes of a free plate on a mesh below a cut-off; see `FreeModes`.

    shift [rad²/s²]: of the factorization; cutoff_frequency [Hz].
    """

    def __init__(self, plate: Plate, mesh: Mesh, *, shift: float, cutoff_frequency: float) -> None:
        self._matrices = matrices = assemble(plate, mesh)
        self._factor = factorize(matrices.stiffness + shift * matrices.mass)
        cut = (2 * math.pi * cutoff_frequency) ** 2
        count = plate.modes_below(cutoff_frequency) + RIGID_BODY_MODES + 4
        while True:
            count = min(count, mesh.dof)
            eigenvalues, vectors = lowest_modes(
                matrices.stiffness, matrices.mass, count, shift=shift
            )
            if eigenvalues[-1] >= cut or count == mesh.dof:
                break
            count += count // 3 + 1
        eigenvalues[:RIGID_BODY_MODES] = 0.0
        vectors[:, :RIGID_BODY_MODES] = _rigid_modes(matrices)
        products = np.linalg.cholesky(vectors.T @ (matrices.mass @ vectors))  # a solver is 1e-7 off
        vectors = linalg.solve_triangular(products, vectors.T, lower=True).T
        kept = int(np.searchsorted(eigenvalues, cut))
        self.eigenvalues, self._vectors = eigenvalues[:kept], vectors[:, :kept]
        self.losses = np.zeros(kept)
        self.dispersion: Dispersion | None = None
        self.largest_truncated = 1 / (float(eigenvalues[min(kept, len(eigenvalues) - 1)]) + shift)
        self._cache = PointCache[FloatArray](_MAX_CACHED)

    def shapes_at(self, points: FloatArray) -> FloatArray:
        """Mode shapes at points [m] (p, 2) or footprints (p, 3), (p, r)."""
        return self._matrices.deflection_at(points) @ self._vectors

    def truncated_terms(self, points: FloatArray, receivers: FloatArray) -> FloatArray:
        """Sums between points (n, 2) and receivers (m, 2)."""
        residuals = self._residuals(points)
        receiver_residuals = self._residuals(receivers)
        forces = np.array([self._matrices.mass @ term.T for term in receiver_residuals])
        terms = np.empty((2 * RESIDUAL_ORDER, residuals.shape[1], receiver_residuals.shape[1]))
        terms[0] = self._matrices.deflection_at(points) @ receiver_residuals[0].T
        for power in range(2, 2 * RESIDUAL_ORDER + 1):
            terms[power - 1] = residuals[power // 2 - 1] @ forces[(power + 1) // 2 - 1]
        return terms

    def basis(self, points: FloatArray, receivers: FloatArray) -> FloatArray:
        """Deflection at receivers of modes and residual vectors, (m, r + RESIDUAL_ORDER n)."""
        (unknowns,) = self.unknowns(points)
        return self._matrices.deflection_at(receivers) @ unknowns

    def unknowns(self, points: FloatArray) -> tuple[FloatArray, ...]:
        """The columns of `basis` in degrees of freedom, in one part."""
        residuals = self._residuals(points).reshape(-1, self._matrices.mesh.dof)
        return (np.hstack([self._vectors, residuals.T]),)

    def _residuals(self, points: FloatArray) -> FloatArray:
        """Residual vectors of forces at points or footprints, (RESIDUAL_ORDER, n, dof)."""
        points = np.atleast_2d(np.asarray(points, dtype=float))
        residuals = self._cache.get(points)
        if residuals is None:
            force = self._matrices.deflection_at(points).T.toarray()
            mass = self._matrices.mass
            vectors = self._vectors
            residuals = np.empty((RESIDUAL_ORDER, *force.T.shape))
            for term in residuals:
                # Modes that are kept would outweigh the others a million times in the solution.
                force -= mass @ (vectors @ (vectors.T @ force))
                displacement = self._factor.solve(force)
                displacement -= vectors @ (vectors.T @ (mass @ displacement))
                term[:] = displacement.T / self.largest_truncated
                force = mass @ term.T
            if residuals.nbytes <= _MAX_KEPT_BYTES:
                self._cache.put(points, residuals)
        return residuals


def _rigid_modes(matrices: PlateMatrices) -> FloatArray:
    """Return heave and both tilts, (dof, 3); a solver returns arbitrary mixtures."""
    nodes, plate = matrices.mesh.nodes, matrices.plate
    modes = np.zeros((len(nodes), DOF_PER_NODE, RIGID_BODY_MODES))
    modes[:, 0, 0] = 1
    modes[:, 0, 1:] = nodes - [plate.length / 2, plate.width / 2]
    modes[:, 1, 1] = modes[:, 2, 2] = 1
    vectors = modes.reshape(matrices.mesh.dof, RIGID_BODY_MODES)
    modal_masses = (vectors * (matrices.mass @ vectors)).sum(axis=0)
    return np.asarray(vectors / np.sqrt(modal_masses))
