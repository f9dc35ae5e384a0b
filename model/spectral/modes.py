"""Modes of one symmetry class, and the response of its truncated modes to any force."""

from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy import linalg

from model.arrays import FloatArray, IntArray
from model.fem.symmetry import CLASSES
from model.spectral.functions import Direction, first_degree
from model.spectral.stiffness import class_stiffness
from model.structure.footprint import mean_over
from model.structure.plate import Plate

# Blocks of the Krylov space: so many before it is tried whether the modes have converged.
_LEAST_BLOCKS = 4

# Residuals relative to u = 1 / (lambda + shift): of a mode that is kept, whose eigenvalue is then
# accurate to about the square, and of the first one beyond.
_CONVERGED, _FOUND = 1e-4, 1e-2


@dataclass(frozen=True, eq=False)
class SpectralClass:
    """Modes of a symmetry class in n unknowns, the first m of them of the deflection.

    eigenvalues omega² (r,) [rad²/s²]; vectors (n, r), orthonormal; largest_truncated:
    1 / (lambda + shift) of the lowest truncated mode [s²/rad²]; factor: Cholesky's of K + shift,
    its lower triangle; deflections: m.
    """

    deflections: int
    factor: FloatArray
    eigenvalues: FloatArray
    vectors: FloatArray
    largest_truncated: float

    def residuals(self, forces: FloatArray, *, terms: int, scale: float) -> FloatArray:
        """Residual vectors of forces on the deflection (k, m): (terms, k, n).

        The j-th term is the sum of phi (phi . force) (u / scale)^j over the truncated modes, u =
        1 / (lambda + shift), j from 1 on.
        """
        count, m = forces.shape
        residuals = np.empty((terms, count, len(self.factor)))
        force = np.zeros((len(self.factor), count), order="F")
        force[:m] = forces.T
        for term in range(terms):
            force, _ = linalg.lapack.dpotrs(self.factor, force, lower=1)
            force -= self.vectors @ (self.vectors.T @ force)
            force /= scale
            residuals[term] = force.T
        return residuals


def deflections_by_class(
    plate: Plate, x: Direction, y: Direction, points: FloatArray
) -> tuple[FloatArray, ...]:
    """Basis of the deflection by class at points [m] (p, 2), each (p, m) [1/sqrt(kg)].

    At footprints (p, 3) its mean.
    """
    evaluate = partial(_deflections, x, y)
    basis = mean_over(evaluate, points, length=plate.length, width=plate.width)
    basis /= np.sqrt(plate.material.rho * plate.thickness)
    ends = np.cumsum([x.polynomial_count(a) * y.polynomial_count(b) for a, b in CLASSES[:-1]])
    return tuple(np.split(basis, ends, axis=1))


def _deflections(x: Direction, y: Direction, points: FloatArray) -> FloatArray:
    """Products of polynomials of x and y at points (p, 2), class after class, (p, n)."""
    along_x, along_y = x.polynomials(points[:, 0]), y.polynomials(points[:, 1])
    basis = np.empty((len(points), along_x.shape[1] * along_y.shape[1]))
    start = 0
    for a, b in CLASSES:
        of_x, of_y = along_x[:, first_degree(a) :: 2], along_y[:, first_degree(b) :: 2]
        shape = (len(points), of_x.shape[1], of_y.shape[1])
        stop = start + shape[1] * shape[2]
        out = basis[:, start:stop].reshape(shape, copy=False)
        np.multiply(of_x[:, :, None], of_y[:, None, :], out=out)
        start = stop
    return basis


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

    count: about how many they are.
    """
    K = class_stiffness(plate, x, y, parity)
    K.reshape(-1, copy=False)[:: len(K) + 1] += shift
    deflections = x.polynomial_count(parity[0]) * y.polynomial_count(parity[1])
    width = min(count // 2 + 2, deflections)
    is_small = _LEAST_BLOCKS * width >= len(K) / 2
    if is_small:
        shifted, vectors = linalg.eigh(K, lower=False, check_finite=False)
    # The upper triangle by rows is the lower one by columns, as LAPACK expects: nothing is copied.
    factor, _ = linalg.lapack.dpotrf(K.T, lower=1, clean=0, overwrite_a=1)
    if not is_small:
        start = _long_waves(x, y, parity, width)
        shifted, vectors = _lowest(factor, start, cut + shift)
    eigenvalues = shifted - shift
    kept = int(np.searchsorted(eigenvalues, cut))
    eigenvalues[np.abs(eigenvalues) < 1e-6 * shift] = 0.0
    return SpectralClass(
        deflections,
        factor,
        eigenvalues[:kept],
        vectors[:, :kept],
        1 / (float(eigenvalues[min(kept, len(eigenvalues) - 1)]) + shift),
    )


def _long_waves(x: Direction, y: Direction, parity: tuple[int, int], count: int) -> IntArray:
    """Numbers of the polynomials of the deflection of a class that have the longest waves."""
    along_x, along_y = (
        np.arange(first_degree(each), direction.degree + 1, 2) / direction.length
        for each, direction in zip(parity, (x, y), strict=True)
    )
    return np.argsort((along_x[:, None] ** 2 + along_y**2).ravel(), kind="stable")[:count]


def _lowest(factor: FloatArray, start: IntArray, cut: float) -> tuple[FloatArray, FloatArray]:
    """Eigenpairs of a positive definite matrix (n, n) below a cut, and some more, ascending.

    Rayleigh-Ritz on a block Krylov space of the inverse, from the Cholesky factor (n, n). It starts
    from forces on the unknowns of these numbers (w,), mixed, since one may be a mode by itself.
    """
    n, width = len(factor), len(start)
    number = np.arange(width)
    block = np.zeros((n, width), order="F")
    block[start] = np.cos(np.pi / width * np.multiply.outer(number + 0.5, number))
    basis = np.empty((n, n // width * width), order="F")
    solved = np.empty_like(basis)
    for size in range(width, basis.shape[1] + 1, width):
        known = basis[:, : size - width]
        for _ in range(
            2 if size > width else 1
        ):  # twice: a mode found exactly leaves only rounding
            block = _orthonormal(block - known @ (known.T @ block))
        basis[:, size - width : size] = block
        solved[:, size - width : size], _ = linalg.lapack.dpotrs(factor, block, lower=1)
        if size < _LEAST_BLOCKS * width:
            block = solved[:, size - width : size]
            continue
        own, block = basis[:, :size], solved[:, size - width : size]
        projected = own.T @ solved[:, :size]
        u, mixture = np.linalg.eigh(projected)
        kept = int(np.searchsorted(-u[::-1], -1 / cut))
        # The inverse leaves the space only from its last block.
        outside = (block - own @ projected[:, -width:]) @ mixture[-width:, : -kept - 2 : -1]
        residuals = np.linalg.norm(outside, axis=0) / u[: -kept - 2 : -1]
        if (residuals[:kept] < _CONVERGED).all() and (residuals[kept:] < _FOUND).any():
            break
    u, mixture = u[::-1].copy(), mixture[:, ::-1]
    u, mixture = u[: kept + 1], mixture[:, : kept + 1]
    vectors = solved[:, :size] @ (mixture / u)
    return 1 / u, vectors / np.linalg.norm(vectors, axis=0)


def _orthonormal(block: FloatArray) -> FloatArray:
    """Orthonormal columns that span those of a block (n, w)."""
    reflectors, scales, _, _ = linalg.lapack.dgeqrf(block)
    columns, _, _ = linalg.lapack.dorgqr(reflectors, scales, overwrite_a=1)
    return np.asarray(columns)
