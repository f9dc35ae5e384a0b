"""Functions of one direction: Legendre polynomials, and the boundary layer of a free edge.

Everything is even or odd about the middle. On a Reissner-Mindlin plate the rotations at a free edge
have a boundary layer exp(-k x) about as wide as the plate is thick, k² = shear / twisting rigidity
(k = sqrt(10) / h), which polynomials resolve only at very high degree. The rotations therefore have
one more function in each direction, exp(-k x) +- exp(-k (L - x)).

All integrals are closed: a polynomial's derivative is a sum of lower polynomials, the integral of
exp(-k x) with a polynomial is a modified spherical Bessel function, and what is left of the layer
beside the polynomials is orthogonal to all their derivatives, so that by parts only its value at
the edge remains.
"""

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import TypeAlias

import numpy as np
from scipy import special

from model.arrays import FloatArray

EVEN, ODD = 1, -1

# A layer with less than this share of its norm outside the polynomials is left out.
_NEGLIGIBLE = 1e-4


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
    n = np.arange(degree + 1)
    below = n - n[:, None]  # n - m for the coefficient of cos(m angle)
    some = (below >= 0) & (below % 2 == 0)
    fewer, more = np.where(some, below // 2, 0), np.where(some, below // 2 + n[:, None], 0)
    coefficients = some * c[fewer] * c[more] * np.where(n == 0, 1, 2)[:, None]
    return np.asarray(coefficients * (-1.0) ** n * np.sqrt(2 * n + 1))


@lru_cache(maxsize=64)
def _unit_integrals(degree: int, decay: float) -> tuple[Integrals, Integrals]:
    """`Direction.slope_products` and `slope_squares` of a unit length."""
    n = np.arange(degree + 1)
    at_end = np.sqrt(2 * n + 1)  # values of the polynomials, and of their slopes
    slope_at_end = at_end * n * (n + 1)
    products, squares = {}, {}
    layer = _layer_integrals(at_end, decay)
    for parity in (EVEN, ODD):
        own, other = (slice(first_degree(each), None, 2) for each in (parity, -parity))
        shape = len(n[own]), len(n[other])
        ends = 2 * at_end[own, None]
        of_degree = n[own, None]
        product = np.zeros((shape[0] + 1, shape[1] + 1))
        product[:-1, :-1] = ends * at_end[other] * (of_degree > n[other])
        square = np.empty((shape[0] + 1, shape[0] + 1))
        least = np.minimum(of_degree, n[own])
        square[:-1, :-1] = ends * at_end[own] * (least * (least + 1))
        norm, norm_of_other, end = layer[parity][0], layer[-parity][0], layer[parity][1]
        product[-1, :-1] = 2 * end * at_end[other]
        square[-1, :-1] = square[:-1, -1] = 2 * end * slope_at_end[own]
        if norm:
            slope = decay * (parity - np.exp(-decay))
            sum_of_slopes = layer[parity][2] @ slope_at_end[own]
            square[-1, -1] = 2 * end * (slope - sum_of_slopes) / norm - decay**2
            product[-1, -1] = -decay * norm_of_other / norm
        rows, columns = (shape[0] + bool(norm), shape[1] + bool(norm_of_other))
        products[parity] = product[:rows, :columns]
        squares[parity] = square[:rows, :rows]
    return products, squares


def _layer_integrals(
    at_end: FloatArray, decay: float
) -> dict[int, tuple[float, float, FloatArray]]:
    """By parity, of the layer beside the polynomials, which have these values at the end (n,).

    Its norm, its value at the end at unit norm, and the integrals of the layer itself with the
    polynomials of its parity. Norm and value are 0 where polynomials represent it.
    """
    n = np.arange(len(at_end))
    bessel = math.sqrt(math.pi / decay) * special.ive(n + 0.5, decay / 2)
    whole = 2 * (-1.0) ** n * at_end * bessel
    both, far = (1 - math.exp(-2 * decay)) / decay, math.exp(-decay)
    found = {}
    for parity in (EVEN, ODD):
        own = slice(first_degree(parity), None, 2)
        square = both + 2 * parity * far
        rest = square - whole[own] @ whole[own]
        norm = math.sqrt(rest) if rest > _NEGLIGIBLE**2 * square else 0.0
        end = float(parity + far - whole[own] @ at_end[own]) / norm if norm else 0.0
        found[parity] = norm, end, np.asarray(whole[own])
    return found
