"""Arrays as kernels take them: for LANES frequencies at once."""

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
