"""Modes of the free plate by symmetry class, each with its factorised stiffness.

`finite_element_classes` solves them on a mesh. `model.reduction.free_plate` needs no more of a
plate than its `ClassModes`.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import linalg, sparse
from scipy.sparse.linalg import LinearOperator, eigsh

from model.arrays import FloatArray
from model.fem.assembly import ElementMatrices, element_matrices
from model.fem.factorisation import Solve, factorise_definite
from model.fem.mesh import Mesh
from model.fem.symmetry import CLASSES, SymmetryClass, symmetry_class
from model.structure.plate import Plate


@dataclass(frozen=True, eq=False)
class ClassModes:
    """One symmetry class in n unknowns: its factorised matrix, and its lowest modes.

    deflection_at: basis (p, n) of the deflection at points [m] (p, 2); solve: (K + shift M) x = f;
    mass M (n, n); eigenvalues omega² (r,) [rad²/s²] and mode shapes Phi (n, r) with
    Phi^T M Phi = I; largest_truncated: 1 / (lambda + shift) of the lowest truncated mode [s²/rad²].
    """

    deflection_at: Callable[[FloatArray], sparse.csr_array]
    solve: Solve
    mass: sparse.csr_array
    eigenvalues: FloatArray
    vectors: FloatArray
    largest_truncated: float

    @property
    def size(self) -> int:
        """Number of unknowns n."""
        return int(self.mass.shape[0])

    @cached_property
    def _mass_weighted_modes(self) -> FloatArray:
        """M Phi, (n, r)."""
        return np.asarray(self.mass @ self.vectors)

    def residuals(self, forces: FloatArray, *, terms: int, scale: float) -> FloatArray:
        """Residual vectors of forces (m, n), and M times them: (2, m, terms, n).

        The j-th term is the sum of phi (phi . force) (u / scale)^j over the truncated modes,
        u = 1 / (lambda + shift), j from 1 on.
        """
        result = np.empty((2, len(forces), terms, forces.shape[1]))
        force = forces.T
        for term in range(terms):
            deflection = self.solve(force) / scale
            # Orthogonalise to the kept modes, twice because of rounding.
            for _ in range(2):
                deflection -= self.vectors @ (self._mass_weighted_modes.T @ deflection)
            force = self.mass @ deflection
            result[0, :, term], result[1, :, term] = deflection.T, force.T
        return result


def finite_element_classes(
    plate: Plate, mesh: Mesh, *, shift: float, cutoff_frequency: float
) -> tuple[ClassModes, ...]:
    """Solve the four symmetry classes of a free plate on a mesh for their modes.

    shift [rad²/s²]: of the factorisations; cutoff_frequency [Hz]: all modes below it are solved.
    """
    elements = element_matrices(plate, mesh)
    max_eigenvalue = (2 * math.pi * cutoff_frequency) ** 2
    count = plate.modes_below(cutoff_frequency) // 4 + 4
    return tuple(
        _solve_class(
            symmetry_class(mesh, parity),
            elements,
            shift=shift,
            max_eigenvalue=max_eigenvalue,
            count=count,
        )
        for parity in CLASSES
    )


def _solve_class(
    symmetry: SymmetryClass,
    elements: ElementMatrices,
    *,
    shift: float,
    max_eigenvalue: float,
    count: int,
) -> ClassModes:
    """Solve for all modes of a class below max_eigenvalue [rad²/s²].

    count: number of modes to compute at first; more where they do not reach it.
    """
    shifted, unsummed = symmetry.assemble(elements, shift)
    solve, mass = factorise_definite(shifted), sparse.csr_array(unsummed)
    while True:
        eigenvalues, vectors = _lowest(solve, mass, count, shift=shift)
        if eigenvalues[-1] >= max_eigenvalue or len(eigenvalues) == symmetry.size:
            break
        count += count // 3 + 1
    kept = int(np.searchsorted(eigenvalues, max_eigenvalue))
    eigenvalues[np.abs(eigenvalues) < 1e-6 * shift] = 0.0
    return ClassModes(
        symmetry.deflection_at,
        solve,
        mass,
        eigenvalues[:kept],
        vectors[:, :kept],
        1 / (float(eigenvalues[min(kept, len(eigenvalues) - 1)]) + shift),
    )


def _lowest(
    solve: Solve, mass: sparse.csr_array, count: int, *, shift: float
) -> tuple[FloatArray, FloatArray]:
    """The lowest eigenpairs; all of them where that costs no more."""
    size = mass.shape[0]
    if count >= size / 2:
        inverse = solve(np.eye(size))
        # u phi = (K + shift M)^-1 M phi, made symmetric with the mass's own root.
        root = linalg.cholesky(mass.toarray(), lower=True)
        u, vectors = linalg.eigh(root.T @ inverse @ root)
        vectors = linalg.solve_triangular(root.T, vectors)
    else:
        eigenvalues, vectors = eigsh(
            mass,  # only its shape is used
            count,
            M=mass,
            sigma=-shift,
            OPinv=LinearOperator(mass.shape, matvec=solve, dtype=float),
            v0=np.random.default_rng(0).standard_normal(size),  # ARPACK's own start is random
        )
        u = 1 / (eigenvalues + shift)
    order = np.argsort(-u, kind="stable")
    return 1 / u[order] - shift, vectors[:, order]
