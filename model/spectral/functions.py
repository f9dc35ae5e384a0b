"""Functions of one direction: Legendre polynomials, and the boundary layer of a free edge.

Everything is even or odd about the middle. On a Reissner-Mindlin plate the rotations at a free edge
have a boundary layer exp(-k x) about as wide as the plate is thick, k² = shear / twisting rigidity
(k = sqrt(10) / h), which polynomials resolve only at very high degree. The rotations therefore have
one more function in each direction, exp(-k x) +- exp(-k (L - x)).
"""

from dataclasses import dataclass
from functools import cached_property, lru_cache

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
        return (self.degree - _first(parity)) // 2 + 1

    def count(self, parity: int) -> int:
        """Number of functions of a parity."""
        return len(self.slope_squares[parity])

    def polynomials(self, parity: int, x: FloatArray) -> FloatArray:
        """Values [1/sqrt(m)] of the polynomials of a parity at x [m] (p,), (p, n)."""
        first = _first(parity)
        every = legvander(2 * x / self.length - 1, self.degree)
        return np.asarray(every[:, first::2] * self._norms[first::2])

    @property
    def slope_products(self) -> dict[int, FloatArray]:
        """By parity: integrals of f' g over the length, f of the parity, g of the other, (n, m)."""
        return self._integrals[0]

    @property
    def slope_squares(self) -> dict[int, FloatArray]:
        """By parity: integrals of f' g' over the length, both of the parity, (n, n)."""
        return self._integrals[1]

    @cached_property
    def _norms(self) -> FloatArray:
        """Factors that make Legendre polynomials orthonormal over the length, (degree + 1,)."""
        return np.sqrt((2 * np.arange(self.degree + 1) + 1) / self.length)

    @cached_property
    def _integrals(self) -> tuple[dict[int, FloatArray], dict[int, FloatArray]]:
        x, weights = self._quadrature()
        xi = 2 * x / self.length - 1
        legendre = np.asarray(legvander(xi, self.degree), dtype=float)
        slopes = np.zeros_like(legendre)
        for n in range(1, self.degree + 1):
            slopes[:, n] = (2 * n - 1) * legendre[:, n - 1]
            if n > 1:
                slopes[:, n] += slopes[:, n - 2]
        legendre *= self._norms
        slopes *= self._norms * (2 / self.length)
        near, far = np.exp(-self.decay * x), np.exp(-self.decay * (self.length - x))
        values, derivatives = {}, {}
        for parity in (EVEN, ODD):
            own = slice(_first(parity), None, 2)
            values[parity], derivatives[parity] = self._with_layer(
                legendre[:, own],
                slopes[:, own],
                near + parity * far,
                self.decay * (parity * far - near),
                weights,
            )
        weighted = {parity: 2 * weights * each.T for parity, each in derivatives.items()}
        products = {parity: each @ values[-parity] for parity, each in weighted.items()}
        squares = {parity: each @ derivatives[parity] for parity, each in weighted.items()}
        return products, squares

    def _quadrature(self) -> tuple[FloatArray, FloatArray]:
        """Gauss points [m] on half of the length, and their weights; twice that is the whole."""
        half = self.length / 2
        ends = _LAYER_PIECES / self.decay
        ends = np.append(ends[ends < half], half)
        points, weights = _gauss(max(_LAYER_POINTS, self.degree + 1))
        start, size = ends[:-1, None], np.diff(ends)[:, None]
        return (start + size * (1 + points) / 2).ravel(), (size * weights / 2).ravel()

    @staticmethod
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


def _first(parity: int) -> int:
    """Degree of the first polynomial of a parity."""
    return (1 - parity) // 2
