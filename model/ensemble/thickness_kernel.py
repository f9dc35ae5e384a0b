"""Responses of `model.ensemble.thickness` by its kernel in C."""

import ctypes
from ctypes import c_int, c_size_t, c_void_p

import numpy as np

from model.arrays import Complex64Array, Float32Array
from model.compiled.kernels import Kernels
from model.compiled.lanes import as_given, work_space

_ARRAYS = ("shapes", "at_points", "receptance", "stiffness", "applied", "minus_omega2")


class _Tones(ctypes.Structure):
    _fields_ = (
        *((name, c_int) for name in ("a", "r", "points")),
        *((name, c_void_p) for name in _ARRAYS),
    )


def responses(kernels: Kernels, **given: Complex64Array | Float32Array) -> Complex64Array:
    """Accelerations (cases, points), of arrays by their names in `thickness.c`."""
    arrays = {name: as_given(given[name]) for name in _ARRAYS}
    cases, r = arrays["receptance"].shape
    points = len(arrays["at_points"])
    pointers = [each.ctypes.data for each in arrays.values()]
    on = ctypes.byref(_Tones(len(arrays["shapes"]), r, points, *pointers))
    found = np.empty((cases, points), dtype=np.complex64)
    library, lanes = kernels.library, kernels.lanes
    library.thickness_space.restype = c_size_t
    work, to = work_space(kernels, library.thickness_space(on)), c_void_p(found.ctypes.data)
    for first in range(0, cases, lanes):
        library.thickness_responses(on, first, min(lanes, cases - first), work, to)
    return found
