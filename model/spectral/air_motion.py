"""Air in a gap behind a plate, in the natural shapes of the pressure between its edges.

Sealed edges hold the flow back, grad p is zero across them: cosines. At open edges p = 0: sines.
The displacement of the air along the gap is a sum of a grad(psi) / k over these shapes psi of
wavenumber k, orthonormal over the plate, and compresses it with the deflection w:

    B d (C w / d - k a)² + rho b d a'²,   C the integrals of psi with the functions of w,

summed over the shapes. Uniform pressure of a sealed gap, k = 0, has no flow.
"""

import math
from dataclasses import dataclass

import numpy as np

from model.arrays import FloatArray
from model.spectral.stiffness import ClassFunctions
from model.structure.plate import AirGap

# Shapes for each degree: at open edges, where the deflection is not zero, they converge slowly.
_PER_DEGREE = 2


@dataclass(frozen=True, eq=False)
class AirMotion:
    """Matrices of w (m functions) and then n flows a.

    stiffness (m + n, m + n): per bulk modulus B; inertia (m + n,): diagonal, per rho b.
    """

    stiffness: FloatArray
    inertia: FloatArray


def air_motion(of: ClassFunctions, gap: AirGap) -> AirMotion:
    """Air of one symmetry class, twice as many shapes along each side as polynomials.

    Where nothing varies along y, a strip of infinite width, the air flows along x only.
    """
    a, b = of.parity
    along_x, kx = _shapes(of.x.points, of.x.length, of.x.degree, a, closed=gap.closed)
    along_y, ky = _shapes(of.y.points, of.y.length, of.y.degree, b, closed=gap.closed)
    coupling = np.kron(
        of.x.polynomial_products(along_x, a).T, of.y.polynomial_products(along_y, b).T
    )
    k = np.hypot(kx[:, None], ky).ravel()
    flows = k > 0
    m, n = coupling.shape[1], int(flows.sum())
    stiffness = np.zeros((m + n, m + n))
    stiffness[:m, :m] = coupling.T @ coupling / gap.depth
    stiffness[m:, :m] = -k[flows, None] * coupling[flows]
    stiffness[:m, m:] = stiffness[m:, :m].T
    stiffness[m:, m:] = np.diag(gap.depth * k[flows] ** 2)
    inertia = np.concatenate([np.zeros(m), np.full(n, gap.depth)])
    return AirMotion(stiffness, inertia)


def _shapes(
    x: FloatArray, length: float, degree: int, parity: int, *, closed: bool
) -> tuple[FloatArray, FloatArray]:
    """Shapes of a parity at x (q,), (q, n), and their wavenumbers [1/m] (n,)."""
    if not degree:
        return np.full((len(x), 1), 1 / math.sqrt(length)), np.zeros(1)
    if closed:
        number = np.arange((1 - parity) // 2, _PER_DEGREE * degree + 1, 2)
        shapes = np.cos(np.pi / length * np.multiply.outer(x, number))
    else:
        number = np.arange((3 - parity) // 2, _PER_DEGREE * degree + 2, 2)
        shapes = np.sin(np.pi / length * np.multiply.outer(x, number))
    norms = np.where(number > 0, math.sqrt(2 / length), math.sqrt(1 / length))
    return np.asarray(shapes * norms), np.asarray(np.pi / length * number)
