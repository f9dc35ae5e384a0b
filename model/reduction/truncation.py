"""Contribution of the truncated modes to a receptance, from a few static solves.

A truncated mode of eigenvalue lambda has the receptance 1 / ((1 + i eta)(lambda - z)),
z = omega² / (1 + i eta). A static solve with the shift sigma gives u = 1 / (lambda + sigma) in its
place, two solves u², and so on; all truncated modes have u within (0, u_c], u_c that of the lowest.
So u / (1 - s u), s = z + sigma, is approximated on that interval by a polynomial in u without
constant term. The optimum follows from Chebyshev's; its relative error for each mode is

    T_k(t(u)) / T_k(t(1 / s)),    t(u) = 2 u / u_c - 1,

exactly. A Taylor series, the usual residual flexibility with its higher terms, gains a factor of
1 / |s u_c| with each term; this polynomial about four times as much.
"""

from functools import lru_cache

import numpy as np
from numpy.polynomial import chebyshev

from model.arrays import ComplexArray, FloatArray

RESIDUAL_ORDER = 4
"""Residual vectors of each point.

A field has this many terms, a receptance between points twice as many, from inner products.
"""


def truncation_weights(
    shifted_eigenvalue: ComplexArray, largest: float, terms: int
) -> ComplexArray:
    """Coefficients c with sum_j c_j (u / u_c)^j near u / (1 - s u) on (0, u_c], (..., terms).

    shifted_eigenvalue: s (...) [rad²/s²], |s u_c| below 1; largest: u_c. Weights have its unit.
    """
    v, inverse = _interpolation(terms)
    exact = 1 / (1 - largest * shifted_eigenvalue[..., None] * v)
    return np.asarray(largest * exact @ inverse.T)


def truncation_slopes(shifted_eigenvalue: ComplexArray, largest: float, terms: int) -> ComplexArray:
    """Derivatives of `truncation_weights` by s, (..., terms)."""
    v, inverse = _interpolation(terms)
    exact = 1 / (1 - largest * shifted_eigenvalue[..., None] * v)
    return np.asarray(largest**2 * (v * exact**2) @ inverse.T)


@lru_cache(maxsize=16)
def _interpolation(terms: int) -> tuple[FloatArray, FloatArray]:
    """Zeros of T_k, where the approximation is exact, and the inverse of their Vandermonde matrix.

    u / (1 - s u) / u is interpolated there.
    """
    v = (chebyshev.chebpts1(terms) + 1) / 2
    return v, np.asarray(np.linalg.inv(np.vander(v, terms, increasing=True)))
