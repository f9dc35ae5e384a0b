"""Modes of one symmetry class of the free plate, with the factorisation used for them."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import linalg, sparse
from scipy.sparse.linalg import LinearOperator, eigsh

from model.arrays import FloatArray
from model.fem.assembly import ElementMatrices
from model.fem.factorisation import Solve, factorise_definite
from model.fem.symmetry import SymmetryClass


@dataclass(frozen=True, eq=False)
class ClassModes:
    """One symmetry class: its factorised matrix, and its modes up to the cut-off.

    solve: (K + shift M) x = f; mass M (n, n); eigenvalues omega² (r,) [rad²/s²] and vectors Phi
    (n, r) with Phi^T M Phi = I; next_eigenvalue: of the lowest truncated mode.
    """

    symmetry: SymmetryClass
    solve: Solve
    mass: sparse.csr_array
    eigenvalues: FloatArray
    vectors: FloatArray
    next_eigenvalue: float

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


def solve_class(
    symmetry: SymmetryClass, elements: ElementMatrices, *, shift: float, cut: float, count: int
) -> ClassModes:
    """Solve for all modes of a class below the cut [rad²/s²].

    count: number of modes to compute at first; more where they do not reach the cut.
    """
    shifted, unsummed = symmetry.assemble(elements, shift)
    solve, mass = factorise_definite(shifted), sparse.csr_array(unsummed)
    while True:
        eigenvalues, vectors = _lowest(solve, mass, count, shift=shift)
        if eigenvalues[-1] >= cut or len(eigenvalues) == symmetry.size:
            break
        count += count // 3 + 1
    kept = int(np.searchsorted(eigenvalues, cut))
    eigenvalues[np.abs(eigenvalues) < 1e-6 * shift] = 0.0
    return ClassModes(
        symmetry,
        solve,
        mass,
        eigenvalues[:kept],
        vectors[:, :kept],
        float(eigenvalues[min(kept, len(eigenvalues) - 1)]),
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
    order = np.argsort(-u)
    return 1 / u[order] - shift, vectors[:, order]
