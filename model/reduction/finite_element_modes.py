"""Modes of the free plate on a mesh, and its truncated ones at points, solved on demand."""

import math

import numpy as np
from scipy import linalg

from model.arrays import FloatArray
from model.fem.mesh import DOF_PER_NODE, Mesh
from model.fem.plate import RIGID_BODY_MODES, PlateMatrices, assemble, factorise, lowest_modes
from model.reduction.truncation import RESIDUAL_ORDER
from model.structure.footprint import as_footprints
from model.structure.modal_elasticity import Dispersion
from model.structure.plate import Plate

_MAX_CACHE_BYTES = 256 << 20  # of solved points


class FiniteElementModes:
    """Modes of a free plate on a mesh, with a cache of solved points (`receptance.FreeModes`).

    cut: all modes of omega² [rad²/s²] below it are solved; shift [rad²/s²]: of the factorisation.
    """

    def __init__(self, matrices: PlateMatrices, *, shift: float, cut: float, count: int) -> None:
        self._matrices = matrices
        self._factor = factorise(matrices.stiffness + shift * matrices.mass)
        eigenvalues, vectors = _modes_below(matrices, cut=cut, count=count, shift=shift)
        kept = int(np.searchsorted(eigenvalues, cut))
        self.eigenvalues, self._vectors = eigenvalues[:kept], vectors[:, :kept]
        self.losses = np.zeros(kept)
        self.dispersion: Dispersion | None = None
        self.largest_truncated = 1 / (float(eigenvalues[min(kept, len(eigenvalues) - 1)]) + shift)
        self._solved: dict[tuple[float, ...], FloatArray] = {}

    def shapes_at(self, points: FloatArray) -> FloatArray:
        """Mode shapes at points [m] (p, 2) or footprints (p, 3), (p, r)."""
        return np.asarray(self._matrices.deflection_at(points) @ self._vectors)

    def truncated_terms(self, points: FloatArray, others: FloatArray) -> FloatArray:
        """Sums between points (n, 2) and others (m, 2)."""
        own, other = self._residuals(points), self._residuals(others)
        heavy = np.array([self._matrices.mass @ each.T for each in other.swapaxes(0, 1)])
        terms = np.empty((2 * RESIDUAL_ORDER, len(own), len(other)))
        terms[0] = self._matrices.deflection_at(points) @ other[:, 0].T
        for power in range(2, 2 * RESIDUAL_ORDER + 1):
            terms[power - 1] = own[:, power // 2 - 1] @ heavy[(power + 1) // 2 - 1]
        return terms

    def basis(self, points: FloatArray, others: FloatArray) -> FloatArray:
        """Deflection at others of modes and residual vectors, (m, r + RESIDUAL_ORDER n)."""
        (unknowns,) = self.unknowns(points)
        return np.asarray(self._matrices.deflection_at(others) @ unknowns)

    def unknowns(self, points: FloatArray) -> tuple[FloatArray, ...]:
        """The columns of `basis` in degrees of freedom, in one part."""
        residuals = self._residuals(points).swapaxes(0, 1).reshape(-1, self._matrices.dof)
        return (np.hstack([self._vectors, residuals.T]),)

    def _residuals(self, points: FloatArray) -> FloatArray:
        """Residual vectors of forces at points or footprints, (n, RESIDUAL_ORDER, dof)."""
        keys = [tuple(place) for place in as_footprints(points).tolist()]
        unknown = [key for key in dict.fromkeys(keys) if key not in self._solved]
        if 8 * RESIDUAL_ORDER * self._matrices.dof * len(self._solved) > _MAX_CACHE_BYTES:
            self._solved, unknown = {}, list(dict.fromkeys(keys))
        if unknown:
            solved = np.empty((RESIDUAL_ORDER, self._matrices.dof, len(unknown)))
            force = self._matrices.deflection_at(np.array(unknown)).T.toarray()
            mass, vectors = self._matrices.mass, self._vectors
            for term in solved:
                # Modes that are kept would outweigh the others a million times in the solution.
                force -= mass @ (vectors @ (vectors.T @ force))
                term[:] = self._factor.solve(force)
                term -= vectors @ (vectors.T @ (mass @ term))
                term /= self.largest_truncated
                force = mass @ term
            self._solved |= zip(unknown, solved.transpose(2, 0, 1), strict=True)
        found = [self._solved[key] for key in keys]
        return np.array(found).reshape(len(keys), RESIDUAL_ORDER, self._matrices.dof)


def finite_element_modes(
    plate: Plate, mesh: Mesh, *, shift: float, cutoff_frequency: float
) -> FiniteElementModes:
    """Solve a free plate on a mesh for all modes below cutoff_frequency [Hz]."""
    return FiniteElementModes(
        assemble(plate, mesh),
        shift=shift,
        cut=(2 * math.pi * cutoff_frequency) ** 2,
        count=plate.modes_below(cutoff_frequency) + RIGID_BODY_MODES + 4,
    )


def _modes_below(
    matrices: PlateMatrices, *, cut: float, count: int, shift: float
) -> tuple[FloatArray, FloatArray]:
    """Eigenvalues omega² (r,), ascending, beyond the cut, and vectors (dof, r).

    count: of modes to compute at first; more where they do not reach it.
    """
    K, M = matrices.stiffness, matrices.mass
    while True:
        if count >= matrices.dof / 2:
            eigenvalues, vectors = linalg.eigh(K.toarray(), M.toarray())
            break
        eigenvalues, vectors = lowest_modes(K, M, count, shift=shift)
        if eigenvalues[-1] >= cut:
            break
        count += count // 3 + 1
    eigenvalues[:RIGID_BODY_MODES] = 0.0
    vectors[:, :RIGID_BODY_MODES] = _rigid_modes(matrices)
    products = np.linalg.cholesky(vectors.T @ (M @ vectors))  # those of the solver are 1e-7 off
    return eigenvalues, linalg.solve_triangular(products, vectors.T, lower=True).T


def _rigid_modes(matrices: PlateMatrices) -> FloatArray:
    """Up and down, and both tilts, (dof, 3): a solver's are some mixture of them."""
    nodes, plate = matrices.mesh.nodes, matrices.plate
    modes = np.zeros((len(nodes), DOF_PER_NODE, RIGID_BODY_MODES))
    modes[:, 0, 0] = 1
    modes[:, 0, 1:] = nodes - [plate.length / 2, plate.width / 2]
    modes[:, 1, 1] = modes[:, 2, 2] = 1
    found = modes.reshape(matrices.dof, RIGID_BODY_MODES)
    return np.asarray(found / np.sqrt((found * (matrices.mass @ found)).sum(axis=0)))
