"""Stiffness and mass of a free plate of one layer or several in the functions of both directions.

Unknowns of a symmetry class: the deflection w, in polynomials; then the displacements along the
plate u_x and u_y of every interface between the layers, with boundary layers. u_x has the other
parity along x, u_y along y. Energy, with the sections of `model.structure.plate` summed over the
interfaces:

    stretch (u_x,x u_x,x + u_y,y u_y,y) + 2 across u_x,x u_y,y + twist (u_x,y + u_y,x)²
    + slip (u_x² + u_y²) + 2 lever (u_x w,x + u_y w,y) + shear (w,x² + w,y²)

with other stretch, slip, lever and shear along x than along y where a material has a grain.

Air in a gap behind the plate, in the natural shapes of the pressure between its edges. Sealed
edges hold the flow back, grad p is zero across them: cosines. At open edges p = 0: sines. The
displacement of the air along the gap is a sum of a grad(psi) / k over these shapes psi of
wavenumber k, orthonormal over the plate, and compresses it with the deflection w:

    B d (C w / d - k a)² + rho b d a'²,   C the integrals of psi with the functions of w,

summed over the shapes. Uniform pressure of a sealed gap, k = 0, has no flow.
"""

import math
from dataclasses import dataclass

import numpy as np
from scipy import linalg

from model.arrays import FloatArray
from model.spectral.functions import EdgedFunctions
from model.structure.laminate_section import CrossSection
from model.structure.plate import AirGap


@dataclass(frozen=True, eq=False)
class ClassFunctions:
    """Functions along x and y of one symmetry class, for a number of interfaces.

    of_w, of_x, of_y: numbers of functions along x and y of w and of one interface's u_x and u_y.
    """

    x: EdgedFunctions
    y: EdgedFunctions
    parity: tuple[int, int]
    interfaces: int

    @property
    def of_w(self) -> tuple[int, int]:
        """Functions of the deflection along x and y."""
        a, b = self.parity
        return self.x.polynomial_count(a), self.y.polynomial_count(b)

    @property
    def of_x(self) -> tuple[int, int]:
        """Functions of u_x along x and y."""
        a, b = self.parity
        return self.x.count(-a), self.y.count(b)

    @property
    def of_y(self) -> tuple[int, int]:
        """Functions of u_y along x and y."""
        a, b = self.parity
        return self.x.count(a), self.y.count(-b)

    @property
    def deflections(self) -> int:
        """Number of unknowns of the deflection, the first ones."""
        nx, ny = self.of_w
        return nx * ny

    @property
    def size(self) -> int:
        """Number of all unknowns."""
        along = self.of_x[0] * self.of_x[1] + self.of_y[0] * self.of_y[1]
        return self.deflections + self.interfaces * along


def class_stiffness(
    of: ClassFunctions, section: CrossSection, by_side: int | None = None
) -> FloatArray:
    """Stiffness (n, n) [N/m per m² of the orthonormal functions] of a section's real part.

    Or its derivative by the logarithm of a side, 0 for length and 1 for width, at the same mass:
    functions are stretched with the side and displacements along it times its reciprocal s, as
    slopes are. Then each part is a power of s, of u_x,x u_x,x the fourth.
    """
    x, y = of.x, of.y
    a, b = of.parity
    (wx, wy), (xx, xy), (yx, yy) = of.of_w, of.of_x, of.of_y
    stretch, across, twist, slip = (
        np.real(each) for each in (section.stretch, section.across, section.twist, section.slip)
    )
    lever, shear = np.real(section.lever)[:, None], np.real(section.shear)[:, None, None]
    w = slice(0, of.deflections)
    u = slice(w.stop, w.stop + of.interfaces * xx * xy)
    v = slice(u.stop, of.size)
    K = np.zeros((of.size, of.size))

    def laid(
        matrix: FloatArray, along_x: FloatArray, along_y: FloatArray, *powers: int
    ) -> FloatArray:
        """One part of the energy; powers of s of both sides in it."""
        factor = 1 if by_side is None else -powers[by_side]
        return _product(factor * matrix, _product(along_x, along_y))

    K[w, w] = laid(shear[0], x.slope_squares[a][:wx, :wx], np.eye(wy), 2, 0)
    K[w, w] += laid(shear[1], np.eye(wx), y.slope_squares[b][:wy, :wy], 0, 2)
    K[u, u] = (
        laid(stretch[0], x.slope_squares[-a], np.eye(xy), 4, 0)
        + laid(twist, np.eye(xx), y.slope_squares[b], 2, 2)
        + laid(slip[0], np.eye(xx), np.eye(xy), 2, 0)
    )
    K[v, v] = (
        laid(stretch[1], np.eye(yx), y.slope_squares[-b], 0, 4)
        + laid(twist, x.slope_squares[a], np.eye(yy), 2, 2)
        + laid(slip[1], np.eye(yx), np.eye(yy), 0, 2)
    )
    K[u, v] = laid(across, x.slope_products[-a], y.slope_products[-b].T, 2, 2)
    K[u, v] += laid(twist, x.slope_products[a].T, y.slope_products[b], 2, 2)
    K[w, u] = laid(lever[0], x.slope_products[a][:wx], np.eye(wy, xy), 2, 0)
    K[w, v] = laid(lever[1], np.eye(wx, yx), y.slope_products[b][:wy], 0, 2)
    K[v, u], K[u, w], K[v, w] = K[u, v].T, K[w, u].T, K[w, v].T
    return K


def _product(left: FloatArray, right: FloatArray) -> FloatArray:
    """Kronecker product of two matrices, as `numpy.kron`, without its checks."""
    shape = len(left) * len(right), left.shape[1] * right.shape[1]
    return np.asarray((left[:, None, :, None] * right[:, None]).reshape(shape))


def along_mass(of: ClassFunctions, mass: FloatArray, forces: FloatArray) -> FloatArray:
    """Mass matrix of the displacements along the plate times columns (m, k): (m, k).

    mass: of `interface_mass`.
    """
    count = of.interfaces * of.of_x[0] * of.of_x[1]
    parts = (
        np.tensordot(mass, each.reshape(of.interfaces, -1, each.shape[1]), axes=1).reshape(
            each.shape
        )
        for each in (forces[:count], forces[count:])
    )
    return np.vstack([*parts])


def follow(of: ClassFunctions, stiffness: FloatArray, mass: FloatArray, shift: float) -> FloatArray:
    """Displacements along the plate under unit deflections, (m, deflections), by least energy.

    shift [rad²/s²]: times the mass, keeps the rigid motions along the plate at rest.
    """
    w = of.deflections
    own = stiffness[w:, w:].copy()
    count = of.interfaces * of.of_x[0] * of.of_x[1]
    for part, each in ((slice(0, count), of.of_x), (slice(count, None), of.of_y)):
        own[part, part] += shift * _product(mass, np.eye(each[0] * each[1]))
    factor = linalg.cho_factor(own, lower=True, overwrite_a=True, check_finite=False)
    return -linalg.cho_solve(factor, stiffness[w:, :w], check_finite=False)


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
