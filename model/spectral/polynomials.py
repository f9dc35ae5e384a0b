"""Basis functions of x and y over a plate, and its matrices, one symmetry class at a time.

Functions of a direction are Legendre polynomials and boundary layers of a free edge, even or odd
about the middle. Displacements along a free edge twist the layers of a plate against each other in
boundary layers exp(-k x), which polynomials resolve only at very high degree. In a homogeneous
layer, the rotations of Reissner and Mindlin have a boundary layer as wide as the thickness, k =
sqrt(10) / h. Each boundary layer has an additional function exp(-k x) +- exp(-k (L - x)). Integrals
are computed by Gauss's rule on pieces that shrink toward the edges.

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
from functools import partial
from itertools import product

import numpy as np
from numpy.polynomial.legendre import leggauss, legvander
from scipy import linalg

from model.arrays import FloatArray
from model.structure.footprints import mean_over
from model.structure.laminate_bending import CrossSection
from model.structure.plate import AirGap

EVEN, ODD = 1, -1

CLASSES = tuple(product((EVEN, ODD), (EVEN, ODD)))
"""Parity about the middle along x and along y of the four symmetry classes."""

# Boundary layers with less than this fraction of their norm outside the existing functions are
# dropped.
_NEGLIGIBLE = 0.02
_ALIKE = 1.5  # ratio of decays for which one function serves
_MAX_LAYERS = 3  # boundary layers of a side
_PIECES = (0.0, 1.5, 5.0, 14.0)  # of a boundary layer, over its decay


class EdgedFunctions:
    """Orthonormal functions of x in (0, length) [m], by parity: EVEN or ODD about the middle.

    Per parity: Legendre polynomials up to a degree, ascending, then boundary layers with these
    decay constants [1/m] at both ends, orthogonalized. slope_products: by parity, integrals of f' g
    over the length, f of the parity, g of the other, (n, m); slope_squares: integrals of f' g',
    both of the parity, (n, n). points: points of the integrals [m] (q,).
    """

    def __init__(self, length: float, degree: int, decays: tuple[float, ...] = ()) -> None:
        self.length = length
        self.degree = degree
        self.points, self._weights = _rule(length, degree, decays)
        self._values = dict[int, FloatArray]()
        slopes = dict[int, FloatArray]()
        polynomials, polynomial_slopes = self._polynomials()
        for parity in (EVEN, ODD):
            of_parity = slice(first_degree(parity), None, 2)
            functions = polynomials[:, of_parity], polynomial_slopes[:, of_parity]
            if self.polynomial_count(parity):
                for decay in decays:
                    functions = self._with_layer(*functions, decay, parity)
            self._values[parity], slopes[parity] = functions
        weights = self._weights[:, None]
        self.slope_products = dict[int, FloatArray]()
        self.slope_squares = dict[int, FloatArray]()
        for parity, f_slopes in slopes.items():
            self.slope_products[parity] = f_slopes.T @ (weights * self._values[-parity])
            self.slope_squares[parity] = f_slopes.T @ (weights * f_slopes)

    def polynomial_count(self, parity: int) -> int:
        """Number of polynomials of a parity; these are its first functions."""
        return count_of(self.degree, parity)

    def count(self, parity: int) -> int:
        """Number of functions of a parity."""
        return int(self._values[parity].shape[1])

    def polynomial_products(self, values: FloatArray, parity: int) -> FloatArray:
        """Integrals with the polynomials of a parity of functions at `points` (q, m), (n, m)."""
        polynomials = self._values[parity][:, : self.polynomial_count(parity)]
        return polynomials.T @ (self._weights[:, None] * values)

    def _polynomials(self) -> tuple[FloatArray, FloatArray]:
        """Values and slopes (q, degree + 1) of all polynomials at the points."""
        degrees = np.arange(self.degree + 1)
        scale = np.sqrt((2 * degrees + 1) / self.length)
        t = 2 * self.points / self.length - 1
        values: FloatArray = np.asarray(legvander(t, self.degree), dtype=float)
        slopes = np.zeros_like(values)
        for degree in degrees[1:]:  # P_n' = n P_(n-1) + t P_(n-1)'
            slopes[:, degree] = degree * values[:, degree - 1] + t * slopes[:, degree - 1]
        return values * scale, slopes * scale * (2 / self.length)

    def _with_layer(
        self, values: FloatArray, slopes: FloatArray, decay: float, parity: int
    ) -> tuple[FloatArray, FloatArray]:
        """Add the boundary layers of a decay [1/m], orthogonal to the functions (q, n) so far.

        Unchanged if the functions represent the layers already.
        """
        near = np.exp(-decay * self.points)
        far = np.exp(-decay * (self.length - self.points))
        layer = near + parity * far
        layer_slope = -decay * (near - parity * far)
        root_weights = np.sqrt(self._weights)
        size = np.linalg.norm(root_weights * layer)
        for _ in range(2):  # once leaves rounding errors
            shares = values.T @ (self._weights * layer)
            layer = layer - values @ shares
            layer_slope = layer_slope - slopes @ shares
        norm = np.linalg.norm(root_weights * layer)
        if norm <= _NEGLIGIBLE * size:
            return values, slopes
        with_layer = np.column_stack([values, layer / norm])
        return with_layer, np.column_stack([slopes, layer_slope / norm])


def _rule(length: float, degree: int, decays: tuple[float, ...]) -> tuple[FloatArray, FloatArray]:
    """Gauss points [m] and weights (q,) of integrals of functions with boundary layers."""
    half = length / 2
    ends = {0.0, half}
    for decay in decays:
        ends.update(piece / decay for piece in _PIECES if piece / decay < half)
    ascending = np.array(sorted(ends))
    sizes = np.diff(ascending)[:, None]
    gauss_points, gauss_weights = leggauss(degree + 12)
    x = (ascending[:-1, None] + sizes * (1 + gauss_points) / 2).ravel()
    weights = (sizes * gauss_weights / 2).ravel()
    both_halves = np.concatenate([x, length - x[::-1]])
    return both_halves, np.concatenate([weights, weights[::-1]])


def count_of(degree: int, parity: int) -> int:
    """Number of polynomials of a parity up to a degree."""
    return (degree - first_degree(parity)) // 2 + 1


def first_degree(parity: int) -> int:
    """Degree of the first polynomial of a parity."""
    return (1 - parity) // 2


def deflections_by_class(
    sides: tuple[float, float], degrees: tuple[int, int], points: FloatArray
) -> Sequence[FloatArray]:
    """Orthonormal polynomials [1/m] over a plate of sides [m] at points (p, 2), (p, m) by class.

    At footprints (p, 3) their mean.
    """
    length, width = sides
    evaluate = partial(_deflections, sides, degrees)
    basis = mean_over(evaluate, points, length=length, width=width)
    sizes = [math.prod(map(count_of, degrees, parities)) for parities in CLASSES]
    return np.split(basis, np.cumsum(sizes[:-1]), axis=1)


def _deflections(
    sides: tuple[float, float], degrees: tuple[int, int], points: FloatArray
) -> FloatArray:
    """Products of polynomials of x and y at points (p, 2), class after class, (p, n)."""
    along_x, along_y = map(_polynomials, points.T, sides, degrees)
    products = list[FloatArray]()
    for x_parity, y_parity in CLASSES:
        of_x = along_x[:, first_degree(x_parity) :: 2]
        of_y = along_y[:, first_degree(y_parity) :: 2]
        count = of_x.shape[1] * of_y.shape[1]
        class_products = of_x[:, :, None] * of_y[:, None]
        products.append(class_products.reshape(len(points), count))
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
    slip = np.real(section.slip[1 - along])
    twist = np.real(section.twist)
    squares = linalg.eigh(slip, twist, eigvals_only=True)[1:]
    decays = list[float]()
    for decay in np.sqrt(np.maximum(squares, 0)):
        is_alike = decays and decay <= _ALIKE * decays[-1]
        if decay > 0 and not is_alike:
            decays.append(float(decay))
    return tuple(decays[:_MAX_LAYERS])


@dataclass(frozen=True, eq=False)
class ClassFunctions:
    """Functions along x and y of a symmetry class, for a number of interfaces.

    of_w, of_x, of_y: numbers of functions along x and y for w, and for u_x and u_y of an interface.
    """

    x: EdgedFunctions
    y: EdgedFunctions
    parity: tuple[int, int]
    interfaces: int

    @property
    def of_w(self) -> tuple[int, int]:
        """Functions of the deflection along x and y."""
        return self.x.polynomial_count(self.parity[0]), self.y.polynomial_count(self.parity[1])

    @property
    def of_x(self) -> tuple[int, int]:
        """Functions of u_x along x and y."""
        return self.x.count(-self.parity[0]), self.y.count(self.parity[1])

    @property
    def of_y(self) -> tuple[int, int]:
        """Functions of u_y along x and y."""
        return self.x.count(self.parity[0]), self.y.count(-self.parity[1])

    @property
    def deflections(self) -> int:
        """Number of unknowns of the deflection, the first ones."""
        return math.prod(self.of_w)

    @property
    def along_x(self) -> int:
        """Number of unknowns of u_x, which follow."""
        return self.interfaces * math.prod(self.of_x)

    @property
    def along_y(self) -> int:
        """Number of unknowns of u_y, the last ones."""
        return self.interfaces * math.prod(self.of_y)

    @property
    def size(self) -> int:
        """Number of all unknowns."""
        return self.deflections + self.along_x + self.along_y

    @property
    def slices(self) -> tuple[slice, slice, slice]:
        """Unknowns of the deflection, of u_x and of u_y."""
        u_start = self.deflections
        v_start = u_start + self.along_x
        return slice(0, u_start), slice(u_start, v_start), slice(v_start, self.size)


def class_stiffness(
    functions: ClassFunctions, section: CrossSection, by_side: int | None = None
) -> FloatArray:
    """Stiffness (n, n) [N/m per m² of the orthonormal functions] of a section's real part.

    Or its derivative by the logarithm of a side, 0 for length and 1 for width, at the same mass:
    functions are stretched with the side and displacements along it times its reciprocal s, as
    slopes are. Then each part is a power of s, of u_x,x u_x,x the fourth.
    """
    x = functions.x
    y = functions.y
    x_parity, y_parity = functions.parity
    w_x, w_y = functions.of_w
    u_x, u_y = functions.of_x
    v_x, v_y = functions.of_y
    stretch = np.real(section.stretch)
    across = np.real(section.across)
    twist = np.real(section.twist)
    slip = np.real(section.slip)
    lever = np.real(section.lever)[:, None]
    shear = np.real(section.shear)[:, None, None]
    w, u, v = functions.slices

    def part(
        matrix: FloatArray, along_x: FloatArray, along_y: FloatArray, *powers: int
    ) -> FloatArray:
        """One part of the energy; powers of s of both sides in it."""
        factor = 1 if by_side is None else -powers[by_side]
        return np.kron(factor * matrix, np.kron(along_x, along_y))

    K = np.zeros((functions.size, functions.size))
    w_slopes_x = x.slope_squares[x_parity][:w_x, :w_x]
    w_slopes_y = y.slope_squares[y_parity][:w_y, :w_y]
    K[w, w] = part(shear[0], w_slopes_x, np.eye(w_y), 2, 0)
    K[w, w] += part(shear[1], np.eye(w_x), w_slopes_y, 0, 2)

    K[u, u] = part(stretch[0], x.slope_squares[-x_parity], np.eye(u_y), 4, 0)
    K[u, u] += part(twist, np.eye(u_x), y.slope_squares[y_parity], 2, 2)
    K[u, u] += part(slip[0], np.eye(u_x), np.eye(u_y), 2, 0)

    K[v, v] = part(stretch[1], np.eye(v_x), y.slope_squares[-y_parity], 0, 4)
    K[v, v] += part(twist, x.slope_squares[x_parity], np.eye(v_y), 2, 2)
    K[v, v] += part(slip[1], np.eye(v_x), np.eye(v_y), 0, 2)

    K[u, v] = part(across, x.slope_products[-x_parity], y.slope_products[-y_parity].T, 2, 2)
    K[u, v] += part(twist, x.slope_products[x_parity].T, y.slope_products[y_parity], 2, 2)
    K[w, u] = part(lever[0], x.slope_products[x_parity][:w_x], np.eye(w_y, u_y), 2, 0)
    K[w, v] = part(lever[1], np.eye(w_x, v_x), y.slope_products[y_parity][:w_y], 0, 2)
    for rows, columns in ((u, v), (w, u), (w, v)):
        K[columns, rows] = K[rows, columns].T
    return K


def along_mass(functions: ClassFunctions, mass: FloatArray, forces: FloatArray) -> FloatArray:
    """Mass matrix of the displacements along the plate times columns (m, k): (m, k).

    mass: of `interface_mass`.
    """
    products = list[FloatArray]()
    for direction in np.split(forces, [functions.along_x]):
        by_interface = direction.reshape(functions.interfaces, -1, direction.shape[1])
        product = np.tensordot(mass, by_interface, axes=1)
        products.append(product.reshape(direction.shape))
    return np.vstack(products)


def follow(
    functions: ClassFunctions, stiffness: FloatArray, mass: FloatArray, shift: float
) -> FloatArray:
    """Displacements along the plate of least energy under unit deflections, (m, deflections).

    shift [rad²/s²]: times the mass, keeps the rigid motions along the plate at rest.
    """
    first = functions.deflections
    along = stiffness[first:, first:].copy()
    u = slice(0, functions.along_x)
    v = slice(functions.along_x, None)
    along[u, u] += shift * np.kron(mass, np.eye(math.prod(functions.of_x)))
    along[v, v] += shift * np.kron(mass, np.eye(math.prod(functions.of_y)))
    factor = linalg.cho_factor(along, lower=True, overwrite_a=True, check_finite=False)
    return -linalg.cho_solve(factor, stiffness[first:, :first], check_finite=False)


# Shapes for each degree: at open edges, where the deflection is not zero, they converge slowly.
_PER_DEGREE = 2


@dataclass(frozen=True, eq=False)
class AirMotion:
    """Matrices of w (m functions) and then n flows a.

    stiffness (m + n, m + n): per bulk modulus B; inertia (m + n,): diagonal, per rho b.
    """

    stiffness: FloatArray
    inertia: FloatArray


def air_motion(functions: ClassFunctions, gap: AirGap) -> AirMotion:
    """Air of a symmetry class, with twice as many shapes along each side as polynomials.

    If nothing varies along y (a strip of infinite width), the air flows only along x.
    """
    x = functions.x
    y = functions.y
    x_parity, y_parity = functions.parity
    shapes_x, wavenumbers_x = _shapes(x.points, x.length, x.degree, x_parity, closed=gap.closed)
    shapes_y, wavenumbers_y = _shapes(y.points, y.length, y.degree, y_parity, closed=gap.closed)
    coupling = np.kron(
        x.polynomial_products(shapes_x, x_parity).T, y.polynomial_products(shapes_y, y_parity).T
    )
    wavenumbers = np.hypot(wavenumbers_x[:, None], wavenumbers_y).ravel()
    flows = wavenumbers > 0
    flow_wavenumbers = wavenumbers[flows]
    function_count = coupling.shape[1]
    flow_count = len(flow_wavenumbers)
    by_deflection = -flow_wavenumbers[:, None] * coupling[flows]
    stiffness = np.block(
        [
            [coupling.T @ coupling / gap.depth, by_deflection.T],
            [by_deflection, np.diag(gap.depth * flow_wavenumbers**2)],
        ]
    )
    inertia = np.repeat([0.0, gap.depth], [function_count, flow_count])
    return AirMotion(stiffness, inertia)


def _shapes(
    x: FloatArray, length: float, degree: int, parity: int, *, closed: bool
) -> tuple[FloatArray, FloatArray]:
    """Shapes of a parity at x (q,), (q, n), and their wavenumbers [1/m] (n,)."""
    if not degree:
        return np.full((len(x), 1), 1 / math.sqrt(length)), np.zeros(1)
    if closed:
        half_waves = np.arange((1 - parity) // 2, _PER_DEGREE * degree + 1, 2)
        shapes = np.cos(np.pi / length * np.multiply.outer(x, half_waves))
    else:
        half_waves = np.arange((3 - parity) // 2, _PER_DEGREE * degree + 2, 2)
        shapes = np.sin(np.pi / length * np.multiply.outer(x, half_waves))
    norms = np.where(half_waves > 0, math.sqrt(2 / length), math.sqrt(1 / length))
    return np.asarray(shapes * norms), np.asarray(np.pi / length * half_waves)
