"""Modes of a free plate, and the response of its truncated modes to forces at points."""

from dataclasses import dataclass

from model.arrays import FloatArray

RESIDUAL_ORDER = 4
"""Residual vectors of each point.

A field has this many terms, a receptance between points twice as many, from inner products.
"""


@dataclass(frozen=True, eq=False)
class PointSolutions:
    """Points [m] (n, 2) where forces act on a free plate, with their residual vectors.

    shapes: (n, r) of the modes; residuals: (n, RESIDUAL_ORDER, size), in truncated modes or degrees
    of freedom; truncated_terms: sums of phi phi' (u / u_c)^j over the truncated modes, j = 1, 2,
    ..., (2 RESIDUAL_ORDER, n, n).
    """

    points: FloatArray
    shapes: FloatArray
    residuals: FloatArray
    truncated_terms: FloatArray
