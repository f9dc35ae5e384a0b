"""Arrays as kernels take them: some cases at once, in lanes beside each other."""

import threading
from ctypes import c_void_p
from typing import Any

import numpy as np
from numpy.typing import NDArray

from model.arrays import Float32Array
from model.compiled.kernels import Kernels

_ALIGNMENT = 16  # floats: the widest vector


def as_given(values: NDArray[Any]) -> NDArray[Any]:
    """Values as a kernel reads them: single precision, one after the other."""
    single = np.complex64 if np.iscomplexobj(values) else np.float32
    return np.ascontiguousarray(values, dtype=single)


def work_space(of: Kernels, size: int) -> c_void_p:
    """Where a kernel may work on a number of complex values of all lanes, until the next one does.

    One for each thread, as large as the largest so far.
    """
    floats = 2 * of.lanes * size
    if len(_kept.work) < floats:
        _kept.work = _aligned(floats)
    return c_void_p(_kept.work.ctypes.data)


class _Kept(threading.local):
    def __init__(self) -> None:
        self.work = _aligned(0)


def _aligned(count: int) -> Float32Array:
    """An empty array whose first element is where a vector of all lanes may begin."""
    room = np.empty(count + _ALIGNMENT, dtype=np.float32)
    start = -room.ctypes.data % (4 * _ALIGNMENT) // 4
    return room[start : start + count]


_kept = _Kept()
