"""What `model.ensemble.contact_forms` finds, by its kernel in C."""

import ctypes
from ctypes import c_float, c_int, c_size_t, c_void_p
from dataclasses import dataclass

import numpy as np

from model.arrays import Complex64Array, Float32Array
from model.compiled.kernels import Kernels
from model.compiled.lanes import as_given, work_space

_SIZES = ("n", "b", "k", "p", "r", "deviating")
_GIVEN = (
    *("shapes", "points", "weights", "receptance", "others", "minus_omega2", "error"),
    *("stiffness", "drives", "strokes", "by_damping", "changes"),
)
_FOUND = ("inverse", "forces", "motion", "fields", "power")


class _Contacts(ctypes.Structure):
    _fields_ = (
        *((name, c_int) for name in _SIZES),
        *((name, c_float) for name in ("gain_variance", "ridge")),
        *((name, c_void_p) for name in (*_GIVEN, *_FOUND)),
    )


@dataclass(frozen=True, eq=False)
class FoundForms:
    """What is found, as of `model.ensemble.contact_forms.LoadedContacts`."""

    inverse: Complex64Array
    forces: Complex64Array
    motion: Complex64Array
    fields: Complex64Array
    power: Complex64Array


def contact_forms(
    kernels: Kernels,
    *,
    gain_variance: float,
    ridge: float,
    **given: Complex64Array | Float32Array,
) -> FoundForms:
    """Find them of arrays by their names in `contact_forms.c`."""
    arrays = {name: as_given(given[name]) for name in _GIVEN}
    f, n = arrays["drives"].shape
    a, r = arrays["shapes"].shape
    kp, _ = arrays["points"].shape
    k, d = arrays["changes"].shape[1] - n, arrays["others"].shape[1]
    found = FoundForms(
        inverse=np.empty((f, a, a), dtype=np.complex64),
        forces=np.empty((f, a, n), dtype=np.complex64),
        motion=np.empty((f, a, n), dtype=np.complex64),
        fields=np.empty((f, k, kp // k, n), dtype=np.complex64),
        power=np.empty((f, k, n, n), dtype=np.complex64),
    )
    on = _Contacts(
        *(n, a - k, k, kp // k, r, d),
        *(gain_variance, ridge),
        *(each.ctypes.data for each in arrays.values()),
        *(getattr(found, name).ctypes.data for name in _FOUND),
    )
    library, lanes = kernels.library, kernels.lanes
    library.contact_forms_space.restype = c_size_t
    work = work_space(kernels, library.contact_forms_space(ctypes.byref(on)))
    for first in range(0, f, lanes):
        library.contact_forms(ctypes.byref(on), first, min(lanes, f - first), work)
    return found
