"""The smallest value of a quadratic form over complex numbers none of which may exceed a bound."""

import numpy as np
from scipy import linalg

from model.arrays import ComplexArray, FloatArray

# With this penalty (relative to the mean of the diagonal) and over-relaxation the forms that
# shaping makes are within 0.1 dB of their minimum after 30 steps; found by trying 1e-4 to 0.3.
_PENALTY = 0.03
_RELAXATION = 1.6
_STEPS = 30


def bounded_solution(A: ComplexArray, b: ComplexArray, bound: FloatArray) -> ComplexArray:
    """x (n,) of least x^H A x - 2 Re b^H x with |x_i| <= bound_i, A Hermitian positive definite.

    The unbounded solution where it keeps the bounds; otherwise by alternating directions (ADMM:
    Boyd and others, 2011, section 5), which ends on a point that keeps them exactly.
    """
    x: ComplexArray = linalg.solve(A, b, assume_a="pos", check_finite=False)
    if (np.abs(x) <= bound).all():
        return x
    penalty = _PENALTY * float(np.trace(A).real) / len(A)
    inverse = np.linalg.inv(A + penalty * np.eye(len(A)))
    offset = inverse @ b
    inverse *= penalty
    kept = _within(x, bound)
    pull = np.zeros_like(x)
    for _ in range(_STEPS):
        x = offset + inverse @ (kept - pull)
        ahead = _RELAXATION * x + (1 - _RELAXATION) * kept + pull
        kept = _within(ahead, bound)
        pull = ahead - kept
    return kept


def _within(x: ComplexArray, bound: FloatArray) -> ComplexArray:
    size = np.abs(x)
    # One in 1e12 less, so that rounding never puts a knot beyond its bound.
    return x * np.where(size > bound, (1 - 1e-12) * bound / np.maximum(size, 1e-300), 1.0)
