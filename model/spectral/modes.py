"""Modes of one symmetry class, and the response of its truncated modes to any force."""

from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy import linalg

from model.arrays import FloatArray
from model.spectral.functions import Direction
from model.spectral.stiffness import class_stiffness
from model.structure.footprint import mean_over
from model.structure.plate import Plate

# Blocks of the Krylov space, each of half of the modes wanted and a few more: eigenvalues are then
# as accurate as those of a full solution.
_BLOCKS = 5
_SPARE = 1


@dataclass(frozen=True, eq=False)
class SpectralClass:
    """Modes of a symmetry class in n unknowns, the first m of them of the deflection.

    eigenvalues omega² (r,) [rad²/s²]; vectors (n, r), orthonormal; largest_truncated:
    1 / (lambda + shift) of the lowest truncated mode [s²/rad²]; factor: Cholesky's of K + shift,
    lower.
    """

    plate: Plate
    x: Direction
    y: Direction
    parity: tuple[int, int]
    shift: float
    factor: FloatArray
    eigenvalues: FloatArray
    vectors: FloatArray
    largest_truncated: float

    @property
    def deflections(self) -> int:
        """Number of unknowns of the deflection, m."""
        a, b = self.parity
        return self.x.polynomial_count(a) * self.y.polynomial_count(b)

    def deflection_at(self, points: FloatArray) -> FloatArray:
        """Basis of the deflection at points or footprints [m] (p, 2 or 3), (p, m) [1/sqrt(kg)]."""
        return deflection_at(self.plate, self.x, self.y, self.parity, points)

    def residual_operators(self, *, terms: int, scale: float) -> FloatArray:
        """Residuals R_j (terms, m, m) between unknowns of the deflection, j from 1 on.

        R_j is the sum of phi phi^T (u / scale)^j over the truncated modes, u = 1 / (lambda +
        shift): R_1 of the inverse of K + shift less the kept modes, R_(i+j) = Y_i^T Y_j.
        """
        m = self.deflections
        kept = self.vectors / np.sqrt(self.eigenvalues + self.shift)
        inverse, _ = linalg.lapack.dpotri(self.factor, lower=1)
        inverse = np.tril(inverse) + np.tril(inverse, -1).T
        inverse -= kept @ kept.T
        inverse /= scale
        powers = [inverse[:, :m]]
        for _ in range((terms - 1) // 2):
            powers.append(inverse @ powers[-1])
        operators = np.empty((terms, m, m))
        operators[0] = powers[0][:m]
        for power in range(2, terms + 1):
            operators[power - 1] = powers[power // 2 - 1].T @ powers[(power + 1) // 2 - 1]
        return operators


def deflection_at(
    plate: Plate, x: Direction, y: Direction, parity: tuple[int, int], points: FloatArray
) -> FloatArray:
    """Basis of the deflection of a class at points [m] (p, 2), (p, m) [1/sqrt(kg)].

    At footprints (p, 3) its mean.
    """
    if points.shape[1] == 3:
        evaluate = partial(deflection_at, plate, x, y, parity)
        return mean_over(evaluate, points, length=plate.length, width=plate.width)
    along_x, along_y = (
        x.polynomials(parity[0], points[:, 0]),
        y.polynomials(parity[1], points[:, 1]),
    )
    basis = along_x[:, :, None] * along_y[:, None, :]
    basis /= np.sqrt(plate.material.rho * plate.thickness)
    return np.asarray(basis.reshape(len(points), along_x.shape[1] * along_y.shape[1]))


def solve_class(
    plate: Plate,
    x: Direction,
    y: Direction,
    parity: tuple[int, int],
    *,
    shift: float,
    cut: float,
    count: int,
) -> SpectralClass:
    """Solve a symmetry class for all modes below the cut [rad²/s²].

    count: number of modes to compute at first; more where they do not reach the cut.
    """
    K = class_stiffness(plate, x, y, parity)
    K[np.diag_indices_from(K)] += shift
    factor, _ = linalg.lapack.dpotrf(K, lower=1)
    while True:
        shifted, vectors = _lowest(K, factor, count)
        if shifted[-1] >= cut + shift or len(shifted) == len(K):
            break
        count += count // 3 + 1
    eigenvalues = shifted - shift
    kept = int(np.searchsorted(eigenvalues, cut))
    eigenvalues[np.abs(eigenvalues) < 1e-6 * shift] = 0.0
    return SpectralClass(
        plate,
        x,
        y,
        parity,
        shift,
        factor,
        eigenvalues[:kept],
        vectors[:, :kept],
        1 / (float(eigenvalues[min(kept, len(eigenvalues) - 1)]) + shift),
    )


def _lowest(shifted: FloatArray, factor: FloatArray, count: int) -> tuple[FloatArray, FloatArray]:
    """The lowest eigenpairs of a positive definite matrix (n, n), from its Cholesky factor.

    Rayleigh-Ritz on a block Krylov space of the inverse.
    """
    n = len(shifted)
    width = count // 2 + _SPARE
    if _BLOCKS * width >= n / 2:
        lowest = [0, min(count, n) - 1]
        eigenvalues, vectors = linalg.eigh(shifted, subset_by_index=lowest, check_finite=False)
        return eigenvalues, vectors
    block = np.asarray(np.random.default_rng(0).standard_normal((n, width)))
    basis = np.empty((n, _BLOCKS * width), dtype=float)
    for number in range(_BLOCKS):
        block = linalg.lapack.dpotrs(factor, block, lower=1)[0]
        known = basis[:, : number * width]
        block -= known @ (known.T @ block)
        block = linalg.qr(block, mode="economic", check_finite=False)[0]
        basis[:, number * width : (number + 1) * width] = block
    basis = linalg.qr(basis, mode="economic", overwrite_a=True, check_finite=False)[0]
    solved, _ = linalg.lapack.dpotrs(factor, basis, lower=1)
    u, mixture = linalg.eigh(basis.T @ solved, check_finite=False)
    u, mixture = u[: -count - 1 : -1].copy(), mixture[:, : -count - 1 : -1]
    vectors = solved @ (mixture / u)
    return 1 / u, vectors / np.linalg.norm(vectors, axis=0)
