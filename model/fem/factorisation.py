"""Factorisations of the plate's matrices: SuperLU, or banded Cholesky on a quarter mesh."""

from collections.abc import Callable
from functools import partial
from typing import TypeAlias

import numpy as np
from scipy import linalg, sparse
from scipy.sparse.linalg import SuperLU, splu

from model.arrays import FloatArray

MAX_BANDWIDTH = 400
"""Up to this a banded Cholesky factor, however full, is faster than SuperLU with its ordering."""

Solve: TypeAlias = Callable[[FloatArray], FloatArray]
"""Solve a factored system for one right-hand side (n,) or several (n, m)."""


def factorise(matrix: sparse.sparray) -> SuperLU:
    """Factorise a matrix with symmetric pattern and a strong diagonal.

    SuperLU's defaults, meant for unsymmetric matrices, take several times longer here; a pivot
    threshold above zero alone made it 80 times slower.
    """
    return splu(
        sparse.csc_array(matrix),
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    )


def factorise_definite(matrix: sparse.coo_array) -> Solve:
    """Factorise a positive definite matrix (n, n) of small bandwidth, entries not yet summed.

    On a quarter of a structured mesh a banded Cholesky factor is three times faster than SuperLU.
    """
    bandwidth = int((matrix.row - matrix.col).max())
    if bandwidth > MAX_BANDWIDTH:
        return factorise(matrix).solve
    lower = matrix.row >= matrix.col
    row, column, values = matrix.row[lower], matrix.col[lower], matrix.data[lower]
    # LAPACK's lower form: entry (i, j) at [i - j, j], column by column.
    size = matrix.shape[0]
    flat = np.bincount(
        column * (bandwidth + 1) + (row - column),
        weights=values,
        minlength=size * (bandwidth + 1),
    )
    band = flat.reshape(size, bandwidth + 1).T
    factor = linalg.cholesky_banded(band, overwrite_ab=True, lower=True, check_finite=False)
    return partial(_solve_banded, factor)


def _solve_banded(factor: FloatArray, right: FloatArray) -> FloatArray:
    return np.asarray(linalg.cho_solve_banded((factor, True), right, check_finite=False))
