"""Arrays as kernels take them: some cases at once, in lanes beside each other."""

import threading
from ctypes import c_void_p
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from model.arrays import Complex64Array, Float32Array
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


def in_lanes(of: Kernels, values: Complex64Array | Float32Array) -> Float32Array:
    """Values (f, ...) in blocks of as many frequencies as lanes, (blocks, ..., parts, lanes).

    parts: real and imaginary, or one of real values; the last block repeats the last frequency.
    """
    blocks = -(-len(values) // of.lanes)
    every = values[_padded(len(values), of.lanes)]
    every = every.reshape(blocks, of.lanes, *values.shape[1:])
    parts = (every.real, every.imag) if np.iscomplexobj(values) else (every,)
    found = _aligned(blocks, *values.shape[1:], len(parts), of.lanes)
    for number, part in enumerate(parts):
        found[..., number, :] = np.moveaxis(part, 1, -1)
    return found


class _Kept(threading.local):
    def __init__(self) -> None:
        self.work = _aligned(0)


def _aligned(*shape: int) -> Float32Array:
    """An empty array whose first element is where a vector of all lanes may begin."""
    count = int(np.prod(shape))
    room = np.empty(count + _ALIGNMENT, dtype=np.float32)
    start = -room.ctypes.data % (4 * _ALIGNMENT) // 4
    return room[start : start + count].reshape(shape)


@cache
def _padded(count: int, lanes: int) -> NDArray[np.int64]:
    """Numbers of frequencies, the last repeated up to a multiple of lanes."""
    return np.minimum(np.arange(-(-count // lanes) * lanes), count - 1)


_kept = _Kept()
