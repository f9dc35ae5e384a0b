"""Modes of a free plate, and the response of its truncated modes to forces at points."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from model.arrays import FloatArray

RESIDUAL_ORDER = 4
"""Residual vectors of each point.

A field has this many terms, a receptance between points twice as many, from inner products.
"""

CacheKey: TypeAlias = tuple[tuple[int, ...], bytes]
"""Shape and content of points or footprints, of which either alone may be those of others."""


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


def unknowns_of(
    modes: Sequence[FloatArray], residuals: Sequence[FloatArray]
) -> tuple[FloatArray, ...]:
    """Join modes (n, r) by class, all after each other, and residual vectors (k, terms, n)."""
    ends = np.cumsum([own.shape[1] for own in modes])
    found = []
    for own, end, residual in zip(modes, ends, residuals, strict=True):
        padded = np.zeros((len(own), ends[-1] + residual.shape[0] * residual.shape[1]))
        padded[:, end - own.shape[1] : end] = own
        padded[:, ends[-1] :] = residual.transpose(2, 1, 0).reshape(len(own), -1)
        found.append(padded)
    return tuple(found)
