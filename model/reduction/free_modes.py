"""Modes of a free plate, and the response of its truncated modes to forces at points."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, TypeAlias

import numpy as np

from model.arrays import FloatArray
from model.structure.dispersion import Dispersion

RESIDUAL_ORDER = 4
"""Residual vectors of each point.

A field has this many terms, a receptance between points twice as many, from inner products.
"""

CacheKey: TypeAlias = tuple[tuple[int, ...], bytes]
"""Shape and content of points or footprints, of which either alone may be those of others."""


@dataclass(frozen=True, eq=False)
class PointSolutions:
    """Points [m] (n, 2) where forces act on a free plate, with their residual vectors.

    shapes: (n, r) of the modes; residuals: by symmetry class, (n, RESIDUAL_ORDER, size);
    truncated_terms: sums of phi phi' (u / u_c)^j over the truncated modes, j = 1, 2, ..., (2
    RESIDUAL_ORDER, n, n).
    """

    points: FloatArray
    shapes: FloatArray
    residuals: tuple[FloatArray, ...]
    truncated_terms: FloatArray


class FreeModes(Protocol):
    """Modes phi of a free plate up to a cut-off, and all truncated ones together by their sums.

    A truncated mode of eigenvalue lambda counts with u = 1 / (lambda + shift), in units of
    largest_truncated, u_c, that of the lowest [s²/rad²]. eigenvalues omega² (r,) [rad²/s²].
    """

    @property
    def eigenvalues(self) -> FloatArray:
        """omega² of the modes (r,) [rad²/s²], class by class; the first of a class may be 0."""

    @property
    def losses(self) -> FloatArray:
        """Imaginary part of the eigenvalues (r,) [rad²/s²] beside the plate's own loss factor."""

    @property
    def dispersion(self) -> Dispersion | None:
        """How eigenvalues change with frequency, None where they do not."""

    @property
    def largest_truncated(self) -> float:
        """1 / (lambda + shift) of the lowest truncated mode [s²/rad²]."""

    def solve_at(self, points: FloatArray) -> PointSolutions:
        """Solve for forces at points [m] (n, 2)."""

    def shapes_at(self, points: FloatArray) -> FloatArray:
        """Mode shapes at points [m] (p, 2) or footprints (p, 3), (p, r) [1/sqrt(kg)]."""

    def truncated_terms(self, points: FloatArray, others: FloatArray) -> FloatArray:
        """Sums between points (n, 2) and others (m, 2), as in `PointSolutions`."""

    def basis(self, attached: PointSolutions, points: FloatArray) -> FloatArray:
        """Deflection at points of modes and residual vectors, (p, r + RESIDUAL_ORDER n).

        Residual vectors come term by term, each for all attachments.
        """

    def unknowns(self, attached: PointSolutions) -> tuple[FloatArray, ...]:
        """The columns of `basis` by symmetry class, in elements or orthonormal polynomials."""


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
