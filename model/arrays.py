"""Array types of signatures, and the points of a lattice."""

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

FloatArray: TypeAlias = NDArray[np.float64]
ComplexArray: TypeAlias = NDArray[np.complex128]
IntArray: TypeAlias = NDArray[np.int64]
Float32Array: TypeAlias = NDArray[np.float32]
Complex64Array: TypeAlias = NDArray[np.complex64]


def lattice(x: FloatArray, y: FloatArray) -> FloatArray:
    """All points of a lattice, (len(x) * len(y), 2): row after row, x running first."""
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
