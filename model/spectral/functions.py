"""Functions of one direction: Legendre polynomials, and boundary layers of a free edge.

Everything is even or odd about the middle. Displacements along a free edge twist the layers of a
plate against each other in boundary layers exp(-k x), which polynomials resolve only at very high
degree: of one homogeneous layer, the rotations of Reissner and Mindlin, one as wide as it is
thick, k = sqrt(10) / h. So there is one more function for each, exp(-k x) +- exp(-k (L - x)).
Integrals are by Gauss's rule on pieces that shrink towards the edges.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import product

import numpy as np
from numpy.polynomial.legendre import leggauss, legvander
from scipy import linalg

from model.arrays import FloatArray
from model.structure.footprint import mean_over
from model.structure.laminate_section import CrossSection

EVEN, ODD = 1, -1

CLASSES = tuple(product((EVEN, ODD), (EVEN, ODD)))
"""Parity about the middle along x and along y of the four symmetry classes."""

# A boundary layer with less than this share of its norm outside what is there already is left out.
_NEGLIGIBLE = 0.02
_ALIKE = 1.5  # ratio of decays for which one function serves
_MAX_LAYERS = 3  # boundary layers of a side
_PIECES = (0.0, 1.5, 5.0, 14.0)  # of a boundary layer, over its decay


@dataclass(frozen=True, eq=False)
class EdgedFunctions:
    """Orthonormal functions of x in (0, length) [m], by parity: EVEN or ODD about the middle.

    Those of a parity are its Legendre polynomials up to a degree, ascending, then boundary layers
    of these decays [1/m] at both ends, orthogonalised.
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

    along: 0 for those along x, of edges across it, 1 for those along y. Displacements along an edge
    twist the layers against each other: twist v'' = slip v over the distance from it. Of one
    homogeneous layer k = sqrt(10) / h, of a board times sqrt(G23 / G12) or sqrt(G13 / G12).
    """
    slip, twist = np.real(section.slip[1 - along]), np.real(section.twist)
    squares = linalg.eigh(slip, twist, eigvals_only=True)[1:]
    decays: list[float] = []
    for k in np.sqrt(np.maximum(squares, 0)):
        if k > 0 and (not decays or k > _ALIKE * decays[-1]):
            decays.append(float(k))
    return tuple(decays[:_MAX_LAYERS])
