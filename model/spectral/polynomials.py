"""Basis functions of x and y over a plate, and its matrices, one symmetry class at a time.

Functions of one direction are Legendre polynomials and boundary layers of a free edge, all of them
even or odd about the middle. Displacements along a free edge twist the layers of a plate against
each other in boundary layers exp(-k x), which polynomials resolve only at very high degree: in one
homogeneous layer the rotations of Reissner and Mindlin have one as wide as it is thick, k =
sqrt(10) / h. So there is one more function for each, exp(-k x) +- exp(-k (L - x)). Integrals are by
Gauss's rule on pieces that shrink towards the edges.

Unknowns of a symmetry class are the deflection w, in polynomials, and the displacements along the
plate u_x and u_y of every interface between the layers, with boundary layers. u_x has the other
parity along x, u_y along y. The energy, with the sections of `model.structure.plate` summed over
the interfaces, is

    stretch (u_x,x u_x,x + u_y,y u_y,y) + 2 across u_x,x u_y,y + twist (u_x,y + u_y,x)²
    + slip (u_x² + u_y²) + 2 lever (u_x w,x + u_y w,y) + shear (w,x² + w,y²)

with other stretch, slip, lever and shear along x than along y where a material has a grain.

Air in a gap behind the plate moves in the natural shapes of the pressure between its edges. Sealed
edges hold the flow back, grad p is zero across them: cosines. At open edges p = 0: sines. The
displacement of the air along the gap is a sum of a grad(psi) / k over these shapes psi of
wavenumber k, orthonormal over the plate, and compresses it with the deflection w:

    B d (C w / d - k a)² + rho b d a'²,   C the integrals of psi with the functions of w,

summed over the shapes. Uniform pressure of a sealed gap, k = 0, has no flow.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import product

import numpy as np
from numpy.polynomial.legendre import leggauss, legvander
from scipy import linalg

from model.arrays import FloatArray
from model.structure.attachments import mean_over
from model.structure.plate import AirGap, CrossSection

EVEN, ODD = 1, -1

CLASSES = tuple(product((EVEN, ODD), (EVEN, ODD)))
"""Parity about the middle along x and along y of the four symmetry classes."""

# Boundary layers with less than this fraction of their norm outside the existing functions are
# dropped.
_NEGLIGIBLE = 0.02
_ALIKE = 1.5  # ratio of decays for which one function serves
_MAX_LAYERS = 3  # boundary layers of a side
_PIECES = (0.0, 1.5, 5.0, 14.0)  # of a boundary layer, over its decay


@dataclass(frozen=True, eq=False)
class EdgedFunctions:
    """Orthonormal functions of x in (0, length) [m], by parity: EVEN or ODD about the middle.

    Per parity: Legendre polynomials up to a degree, ascending, then boundary layers with these
    decay constants [1/m] at both ends, orthogonalised.
    """

    length: float
    degree: int
    decays: tuple[float, ...] = ()

    def polynomial_count(self, parity: int) -> int:
        """Number of polynomials of a parity; these are its first functions."""
        return (self.degree - first_degree(parity)) // 2 + 1 if self._has(parity) else 0

    def count(self, parity: int) -> int:
        """Number of functions of a parity."""
        return int(self._values[parity].shape[1])

    @cached_property
    def slope_products(self) -> dict[int, FloatArray]:
        """By parity: integrals of f' g over the length, f of the parity, g of the other, (n, m)."""
        return {
            parity: self._slopes[parity].T @ (self._weights[:, None] * self._values[-parity])
            for parity in (EVEN, ODD)
        }

    @cached_property
    def slope_squares(self) -> dict[int, FloatArray]:
        """By parity: integrals of f' g' over the length, both of the parity, (n, n)."""
        return {
            parity: slopes.T @ (self._weights[:, None] * slopes)
            for parity, slopes in self._slopes.items()
        }

    def polynomial_products(self, values: FloatArray, parity: int) -> FloatArray:
        """Integrals with the polynomials of a parity of functions at `points` (q, m), (n, m)."""
        own = self._values[parity][:, : self.polynomial_count(parity)]
        return np.asarray(own.T @ (self._weights[:, None] * values))

    @property
    def points(self) -> FloatArray:
        """Points of the integrals [m] (q,)."""
        return self._rule[0]

    @property
    def _weights(self) -> FloatArray:
        return self._rule[1]

    @cached_property
    def _rule(self) -> tuple[FloatArray, FloatArray]:
        half = self.length / 2
        breaks = {piece / decay for decay in self.decays for piece in _PIECES}
        edges = np.array(sorted({0.0, half, *(each for each in breaks if each < half)}))
        t, w = leggauss(self.degree + 12)
        sizes = np.diff(edges)
        x = (edges[:-1, None] + sizes[:, None] * (1 + t) / 2).ravel()
        weights = (sizes[:, None] * w / 2).ravel()
        return np.concatenate([x, self.length - x[::-1]]), np.concatenate([weights, weights[::-1]])

    def _has(self, parity: int) -> bool:
        return self.degree >= first_degree(parity)

    @property
    def _values(self) -> dict[int, FloatArray]:
        return self._functions[0]

    @property
    def _slopes(self) -> dict[int, FloatArray]:
        return self._functions[1]

    @cached_property
    def _functions(self) -> tuple[dict[int, FloatArray], dict[int, FloatArray]]:
        """Values and slopes at the points, by parity."""
        x, weights = self._rule
        n = np.arange(self.degree + 1)
        scale = np.sqrt((2 * n + 1) / self.length)
        t = 2 * x / self.length - 1
        values: FloatArray = np.asarray(legvander(t, self.degree), dtype=float)
        slopes = np.zeros_like(values)
        for each in n[1:]:
            slopes[:, each] = each * values[:, each - 1] + t * slopes[:, each - 1]
        values, slopes = values * scale, slopes * scale * (2 / self.length)
        root = np.sqrt(weights)[:, None]
        found: tuple[dict[int, FloatArray], dict[int, FloatArray]] = ({}, {})
        for parity in (EVEN, ODD):
            own = slice(first_degree(parity), None, 2)
            value, slope = values[:, own], slopes[:, own]
            for k in self.decays if self._has(parity) else ():
                near, far = np.exp(-k * x), np.exp(-k * (self.length - x))
                layer, rate = near + parity * far, -k * (near - parity * far)
                size = np.linalg.norm(root[:, 0] * layer)
                for _ in range(2):
                    shares = value.T @ (weights * layer)
                    layer, rate = layer - value @ shares, rate - slope @ shares
                norm = np.linalg.norm(root[:, 0] * layer)
                if norm > _NEGLIGIBLE * size:
                    value = np.column_stack([value, layer / norm])
                    slope = np.column_stack([slope, rate / norm])
            found[0][parity], found[1][parity] = value, slope
        return found


def first_degree(parity: int) -> int:
    """Degree of the first polynomial of a parity."""
    return (1 - parity) // 2


def deflections_by_class(
    sides: tuple[float, float], degrees: tuple[int, int], points: FloatArray
) -> Sequence[FloatArray]:
    """Orthonormal polynomials [1/m] over a plate of sides [m] at points (p, 2), (p, m) by class.

    At footprints (p, 3) their mean.
    """
    basis = mean_over(
        partial(_deflections, sides, degrees), points, length=sides[0], width=sides[1]
    )
    counts = [[(degree - first_degree(a)) // 2 + 1 for a in (EVEN, ODD)] for degree in degrees]
    of = {EVEN: 0, ODD: 1}
    ends = np.cumsum([counts[0][of[a]] * counts[1][of[b]] for a, b in CLASSES[:-1]])
    return np.split(basis, ends, axis=1)


def _deflections(
    sides: tuple[float, float], degrees: tuple[int, int], points: FloatArray
) -> FloatArray:
    """Products of polynomials of x and y at points (p, 2), class after class, (p, n)."""
    along_x, along_y = map(_polynomials, points.T, sides, degrees)
    products = []
    for a, b in CLASSES:
        of_x, of_y = along_x[:, first_degree(a) :: 2], along_y[:, first_degree(b) :: 2]
        count = of_x.shape[1] * of_y.shape[1]
        products.append((of_x[:, :, None] * of_y[:, None]).reshape(len(points), count))
    return np.hstack(products)


def _polynomials(x: FloatArray, length: float, degree: int) -> FloatArray:
    """Values [1/sqrt(m)] of all orthonormal polynomials, by degree, at x [m], (p, degree + 1)."""
    scale = np.sqrt((2 * np.arange(degree + 1) + 1) / length)
    return np.asarray(legvander(2 * x / length - 1, degree) * scale)


def edge_decays(section: CrossSection, along: int) -> tuple[float, ...]:
    """Decays [1/m] of the boundary layers of a laminate's free edge, the widest first.

    along: 0 for decay along x, at edges across it, 1 for decay along y. Displacements along an edge
    twist the layers against each other: twist v'' = slip v over the distance from it. For a
    homogeneous layer k = sqrt(10) / h, for a board times sqrt(G23 / G12) or sqrt(G13 / G12).
    """
    slip, twist = np.real(section.slip[1 - along]), np.real(section.twist)
    squares = linalg.eigh(slip, twist, eigvals_only=True)[1:]
    decays: list[float] = []
    for k in np.sqrt(np.maximum(squares, 0)):
        if k > 0 and (not decays or k > _ALIKE * decays[-1]):
            decays.append(float(k))
    return tuple(decays[:_MAX_LAYERS])


@dataclass(frozen=True, eq=False)
class ClassFunctions:
    """Functions along x and y of a symmetry class, for a number of interfaces.

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
    """Air of a symmetry class, with twice as many shapes along each side as polynomials.

    If nothing varies along y (a strip of infinite width), the air flows only along x.
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
