"""Modes of the free plate on a mesh, and its truncated ones at points, solved on demand."""

import math

import numpy as np
from scipy import linalg

from model.arrays import FloatArray
from model.fem.mesh import DOF_PER_NODE, Mesh
from model.fem.plate import RIGID_BODY_MODES, PlateMatrices, assemble, factorise, lowest_modes
from model.reduction.truncation import RESIDUAL_ORDER
from model.structure.modal_elasticity import Dispersion
from model.structure.plate import Plate

_MAX_CACHED = 4  # sets of points whose residual vectors are kept
_MAX_KEPT_BYTES = 1 << 26  # of each: those of a map's raster are solved for it alone


class FiniteElementModes:
    """All modes of a free plate on a mesh below a cut-off; see `FreeModes` of `receptance`.

    shift [rad²/s²]: of the factorisation; cutoff_frequency [Hz].
    """

    def __init__(self, plate: Plate, mesh: Mesh, *, shift: float, cutoff_frequency: float) -> None:
        self._matrices = matrices = assemble(plate, mesh)
        self._factor = factorise(matrices.stiffness + shift * matrices.mass)
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
        self._known: dict[tuple[tuple[int, ...], bytes], FloatArray] = {}

    def shapes_at(self, points: FloatArray) -> FloatArray:
        """Mode shapes at points [m] (p, 2) or footprints (p, 3), (p, r)."""
        return np.asarray(self._matrices.deflection_at(points) @ self._vectors)

    def truncated_terms(self, points: FloatArray, others: FloatArray) -> FloatArray:
        """Sums between points (n, 2) and others (m, 2)."""
        own, other = self._residuals(points), self._residuals(others)
        heavy = np.array([self._matrices.mass @ each.T for each in other])
        terms = np.empty((2 * RESIDUAL_ORDER, own.shape[1], other.shape[1]))
        terms[0] = self._matrices.deflection_at(points) @ other[0].T
        for power in range(2, 2 * RESIDUAL_ORDER + 1):
            terms[power - 1] = own[power // 2 - 1] @ heavy[(power + 1) // 2 - 1]
        return terms

    def basis(self, points: FloatArray, others: FloatArray) -> FloatArray:
        """Deflection at others of modes and residual vectors, (m, r + RESIDUAL_ORDER n)."""
        (unknowns,) = self.unknowns(points)
        return np.asarray(self._matrices.deflection_at(others) @ unknowns)

    def unknowns(self, points: FloatArray) -> tuple[FloatArray, ...]:
        """The columns of `basis` in degrees of freedom, in one part."""
        residuals = self._residuals(points).reshape(-1, self._matrices.mesh.dof)
        return (np.hstack([self._vectors, residuals.T]),)

    def _residuals(self, points: FloatArray) -> FloatArray:
        """Residual vectors of forces at points or footprints, (RESIDUAL_ORDER, n, dof)."""
        points = np.atleast_2d(np.asarray(points, dtype=float))
        key = points.shape, points.tobytes()
        known = self._known.get(key)
        if known is None:
            force = self._matrices.deflection_at(points).T.toarray()
            mass, vectors = self._matrices.mass, self._vectors
            known = np.empty((RESIDUAL_ORDER, *force.T.shape))
            for term in known:
                # Modes that are kept would outweigh the others a million times in the solution.
                force -= mass @ (vectors @ (vectors.T @ force))
                found = self._factor.solve(force)
                found -= vectors @ (vectors.T @ (mass @ found))
                term[:] = found.T / self.largest_truncated
                force = mass @ term.T
            if known.nbytes <= _MAX_KEPT_BYTES:
                self._known[key] = known
                if len(self._known) > _MAX_CACHED:
                    self._known.pop(next(iter(self._known)))
        return known


def _rigid_modes(matrices: PlateMatrices) -> FloatArray:
    """Up and down, and both tilts, (dof, 3): a solver's are some mixture of them."""
    nodes, plate = matrices.mesh.nodes, matrices.plate
    modes = np.zeros((len(nodes), DOF_PER_NODE, RIGID_BODY_MODES))
    modes[:, 0, 0] = 1
    modes[:, 0, 1:] = nodes - [plate.length / 2, plate.width / 2]
    modes[:, 1, 1] = modes[:, 2, 2] = 1
    found = modes.reshape(matrices.mesh.dof, RIGID_BODY_MODES)
    return np.asarray(found / np.sqrt((found * (matrices.mass @ found)).sum(axis=0)))
