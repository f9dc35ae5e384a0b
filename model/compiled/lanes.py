"""Arrays as kernels take them: for LANES frequencies at once."""

import threading
from ctypes import c_void_p
from functools import cache

import numpy as np
from numpy.typing import NDArray

from model.arrays import Complex64Array, Float32Array

LANES = 16
"""Frequencies that a kernel works on at once."""


def aligned(*shape: int) -> Float32Array:
    """An empty array whose first element is where a vector of all lanes may begin."""
    count, size = int(np.prod(shape)), 4 * LANES
    room = np.empty(count + LANES, dtype=np.float32)
    start = -room.ctypes.data % size // 4
    return room[start : start + count].reshape(shape)


def work_space(size: int) -> c_void_p:
    """Where a kernel may work on a number of complex values of all lanes, until the next one does.

    One for each thread, as large as the largest so far.
    """
    if len(_kept.work) < size:
        _kept.work = aligned(size, 2 * LANES)
    return c_void_p(_kept.work.ctypes.data)


class _Kept(threading.local):
    work = aligned(0, 2 * LANES)


_kept = _Kept()


def in_lanes(values: Complex64Array | Float32Array) -> Float32Array:
    """Values (f, ...) in blocks of LANES frequencies, (blocks, ..., parts, LANES).

    parts: real and imaginary, or one of real values; the last block repeats the last frequency.
    """
    blocks = -(-len(values) // LANES)
    every = values[_padded(len(values))].reshape(blocks, LANES, *values.shape[1:])
    parts = (every.real, every.imag) if np.iscomplexobj(values) else (every,)
    found = aligned(blocks, *values.shape[1:], len(parts), LANES)
    for number, part in enumerate(parts):
        found[..., number, :] = np.moveaxis(part, 1, -1)
    return found


@cache
def _padded(count: int) -> NDArray[np.int64]:
    """Numbers of frequencies, the last repeated up to a multiple of LANES."""
    return np.minimum(np.arange(-(-count // LANES) * LANES), count - 1)
