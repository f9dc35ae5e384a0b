"""Arrays as kernels take them."""

from ctypes import c_void_p
from typing import Any

import numpy as np
from numpy.typing import NDArray


def as_given(values: NDArray[Any]) -> NDArray[Any]:
    """Values as a kernel reads them: single precision, or integers of 32 bits, one by one."""
    if np.issubdtype(values.dtype, np.integer):
        return np.ascontiguousarray(values, dtype=np.int32)
    single = np.complex64 if np.iscomplexobj(values) else np.float32
    return np.ascontiguousarray(values, dtype=single)


def address_of(array: NDArray[Any]) -> c_void_p:
    """Where an array that is as given begins."""
    return c_void_p(array.ctypes.data)
