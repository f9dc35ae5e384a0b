"""What the modes beyond the highest kept one add to a receptance, from a few solves.

A truncated mode of eigenvalue lambda answers at frequency omega with 1 / (1 + i eta)(lambda - z),
z = omega² / (1 + i eta). The solved static problem with the shift sigma answers with
u = 1 / (lambda + sigma) in its place, solved twice with u², and so on; and all the truncated modes
have u within (0, u_c], u_c being that of the lowest of them. So the wanted u / (1 - s u),
s = z + sigma, is approximated over that interval by a polynomial in u without constant term, the
best of which comes from Chebyshev's: each mode's share is then wrong by the factor

    T_k(t(u)) / T_k(t(1 / s)),    t(u) = 2 u / u_c - 1,

exactly. A Taylor series, the usual residual flexibility and its higher terms, converges with
s u_c per term; this one about four times faster.
"""

import numpy as np
from numpy.polynomial import chebyshev

from model.arrays import ComplexArray


def truncation_weights(
    shifted_eigenvalue: ComplexArray, largest: float, terms: int
) -> ComplexArray:
    """Coefficients c with sum_j c_j (u / u_c)^j near u / (1 - s u) on (0, u_c]: (f, terms).

    shifted_eigenvalue: s (f,) [rad²/s²], |s u_c| below 1; largest: u_c. Weights have its unit.
    """
    # Where T_k is zero the approximation is exact: interpolate u / (1 - s u) / u there.
    v = (chebyshev.chebpts1(terms) + 1) / 2
    exact = 1 / (1 - largest * shifted_eigenvalue[:, None] * v)
    inverse = np.linalg.inv(np.vander(v, terms, increasing=True))
    return np.asarray(largest * exact @ inverse.T)
