"""Array types of signatures, the points of a lattice, and how near points are."""

from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

FloatArray: TypeAlias = NDArray[np.float64]
ComplexArray: TypeAlias = NDArray[np.complex128]
IntArray: TypeAlias = NDArray[np.int64]
Float32Array: TypeAlias = NDArray[np.float32]
Complex64Array: TypeAlias = NDArray[np.complex64]

Point: TypeAlias = tuple[float, float]
"""x, y [m]."""


def lattice(x: FloatArray, y: FloatArray) -> FloatArray:
    """All points of a lattice, (len(x) * len(y), 2): row after row, x running first."""
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def least_gap(places: FloatArray) -> float:
    """Least distance of any two of some places (n, 2), infinite for fewer than two."""
    gaps = np.linalg.norm(places[:, None] - places, axis=-1)
    return float(gaps[np.triu_indices(len(places), 1)].min(initial=np.inf))


def nullable(values: ArrayLike | None) -> Any:
    """Numbers for JSON, an array as lists: None in place of what is not finite or not there."""
    found = np.asarray(values, dtype=float)
    return np.where(np.isfinite(found), found, np.array(None)).tolist()
