"""Functions of one direction: Legendre polynomials, and the boundary layer of a free edge.

Everything is even or odd about the middle. On a Reissner-Mindlin plate the rotations at a free edge
have a boundary layer exp(-k x) about as wide as the plate is thick, k² = shear / twisting rigidity
(k = sqrt(10) / h), which polynomials resolve only at very high degree. The rotations therefore have
one more function in each direction, exp(-k x) +- exp(-k (L - x)).
"""

from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import TypeAlias

import numpy as np
from numpy.polynomial.legendre import leggauss, legvander

from model.arrays import FloatArray

EVEN, ODD = 1, -1

# Pieces in which products with the boundary layer are integrated, in decay lengths 1 / k, and the
# least number of Gauss points of each.
_LAYER_PIECES = np.array([0.0, 1.5, 5.0, 14.0])
_LAYER_POINTS = 14

# A layer with less than this share of its norm outside the polynomials is left out.
_NEGLIGIBLE = 1e-6


Integrals: TypeAlias = dict[int, FloatArray]
"""Integrals over the length of products of two functions, by parity of the first, (n, m)."""


@dataclass(frozen=True, eq=False)
class Direction:
    """Orthonormal functions of x in (0, length) [m], by parity: EVEN or ODD about the middle.

    Those of a parity are its Legendre polynomials up to a degree, ascending, then the boundary
    layer of decay k [1/m], orthogonalised to them, unless they represent it.
    """

    length: float
    degree: int
    decay: float

    def polynomial_count(self, parity: int) -> int:
        """Number of polynomials of a parity; these are its first functions."""
        return (self.degree - first_degree(parity)) // 2 + 1

    def count(self, parity: int) -> int:
        """Number of functions of a parity."""
        return len(self.slope_squares[parity])

    def polynomials(self, x: FloatArray) -> FloatArray:
        """Values [1/sqrt(m)] of all polynomials, by degree, at x [m] (p,), (p, degree + 1)."""
        angle = np.arccos(np.clip(1 - 2 * x / self.length, -1, 1))
        cosines = np.cos(np.multiply.outer(angle, np.arange(self.degree + 1)))
        values = cosines @ _polynomials_in_cosines(self.degree)
        return np.asarray(values / np.sqrt(self.length))

    @cached_property
    def slope_products(self) -> Integrals:
        """By parity: integrals of f' g over the length, f of the parity, g of the other, (n, m)."""
        products, _ = _unit_integrals(self.degree, self.decay * self.length)
        return {parity: each / self.length for parity, each in products.items()}

    @cached_property
    def slope_squares(self) -> Integrals:
        """By parity: integrals of f' g' over the length, both of the parity, (n, n)."""
        _, squares = _unit_integrals(self.degree, self.decay * self.length)
        return {parity: each / self.length**2 for parity, each in squares.items()}


def first_degree(parity: int) -> int:
    """Degree of the first polynomial of a parity."""
    return (1 - parity) // 2


@lru_cache(maxsize=64)
def _polynomials_in_cosines(degree: int) -> FloatArray:
    """Coefficients (degree + 1, degree + 1) of orthonormal polynomials at -cos(angle).

    Rows are cos(n angle), columns polynomials on a unit length: P_n(cos a) is the sum of
    c_k c_(n-k) cos((n - 2 k) a), c_k = (2 k - 1)!! / (2 k)!!, all positive, so nothing cancels.
    """
    k = np.arange(1, degree + 1)
    c = np.concatenate([[1.0], np.cumprod((2 * k - 1) / (2 * k))])
    coefficients = np.zeros((degree + 1, degree + 1))
    for n in range(degree + 1):
        np.add.at(coefficients[:, n], abs(n - 2 * np.arange(n + 1)), c[: n + 1] * c[n::-1])
    signs = (-1.0) ** np.arange(degree + 1)
    return coefficients * signs * np.sqrt(2 * np.arange(degree + 1) + 1)


@lru_cache(maxsize=64)
def _unit_integrals(degree: int, decay: float) -> tuple[Integrals, Integrals]:
    """`Direction.slope_products` and `slope_squares` of a unit length."""
    x, weights = _quadrature(degree, decay)
    legendre = np.asarray(legvander(2 * x - 1, degree), dtype=float)
    slopes = np.zeros_like(legendre)
    for n in range(1, degree + 1):
        slopes[:, n] = (2 * n - 1) * legendre[:, n - 1]
        if n > 1:
            slopes[:, n] += slopes[:, n - 2]
    norms = np.sqrt(2 * np.arange(degree + 1) + 1)
    legendre *= norms
    slopes *= 2 * norms
    near, far = np.exp(-decay * x), np.exp(-decay * (1 - x))
    values, derivatives = {}, {}
    for parity in (EVEN, ODD):
        own = slice(first_degree(parity), None, 2)
        values[parity], derivatives[parity] = _with_layer(
            legendre[:, own],
            slopes[:, own],
            near + parity * far,
            decay * (parity * far - near),
            weights,
        )
    weighted = {parity: 2 * weights * each.T for parity, each in derivatives.items()}
    products = {parity: each @ values[-parity] for parity, each in weighted.items()}
    squares = {parity: each @ derivatives[parity] for parity, each in weighted.items()}
    return products, squares


def _quadrature(degree: int, decay: float) -> tuple[FloatArray, FloatArray]:
    """Gauss points on half of a unit length, and their weights; twice that is the whole."""
    ends = _LAYER_PIECES / decay
    ends = np.append(ends[ends < 0.5], 0.5)
    points, weights = _gauss(max(_LAYER_POINTS, degree + 1))
    start, size = ends[:-1, None], np.diff(ends)[:, None]
    return (start + size * (1 + points) / 2).ravel(), (size * weights / 2).ravel()


def _with_layer(
    values: FloatArray,
    slopes: FloatArray,
    layer: FloatArray,
    layer_slope: FloatArray,
    weights: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Append the layer, orthonormal to polynomials with these values and slopes (q, n)."""
    weighted = 2 * weights * values.T
    whole = 2 * weights @ layer**2
    for _ in range(2):  # twice because of rounding
        projection = weighted @ layer
        layer, layer_slope = layer - values @ projection, layer_slope - slopes @ projection
    norm = np.sqrt(2 * weights @ layer**2)
    if norm < _NEGLIGIBLE * np.sqrt(whole):
        return values, slopes
    return (
        np.column_stack([values, layer / norm]),
        np.column_stack([slopes, layer_slope / norm]),
    )


@lru_cache(maxsize=32)
def _gauss(count: int) -> tuple[FloatArray, FloatArray]:
    return leggauss(count)
