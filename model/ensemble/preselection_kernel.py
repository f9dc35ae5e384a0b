"""The scores of `model.ensemble.preselection` by its kernel in C."""

import ctypes
from ctypes import c_float, c_int, c_size_t, c_void_p
from dataclasses import dataclass

import numpy as np

from model.arrays import Complex64Array, Float32Array
from model.compiled.kernels import Kernels, kernels
from model.compiled.lanes import as_given, in_lanes, work_space

_MATRICES = ("modal", "receptance", "fields", "held", "by_damping", "by_stiffness", "error")


class _Plate(ctypes.Structure):
    _fields_ = (
        *((name, c_int) for name in ("n", "b", "r")),
        *((name, c_float) for name in ("gain_variance", "ridge")),
        *((name, c_void_p) for name in _MATRICES),
    )


@dataclass(frozen=True, eq=False)
class PreselectionKernel:
    """A plate of f frequencies as the kernel takes it, block by block of frequencies."""

    kernels: Kernels
    count: int
    plates: list[_Plate]
    matrices: list[Float32Array]

    @classmethod
    def of(
        cls, *, gain_variance: float, ridge: float, **matrices: Complex64Array | Float32Array
    ) -> "PreselectionKernel | None":
        """Of matrices (f, ...) by their names in `preselection.c`; None without a library."""
        by = kernels()
        if by is None:
            return None
        by.library.preselection_space.restype = c_size_t
        lanes = [in_lanes(by, matrices[name]) for name in _MATRICES]
        f, b, _ = matrices["held"].shape
        size = (matrices["error"].shape[1], b, matrices["receptance"].shape[1])
        plates = [
            _Plate(*size, gain_variance, ridge, *(each.ctypes.data for each in block))
            for block in zip(*lanes, strict=True)
        ]
        return cls(by, f, plates, lanes)

    def score(
        self, points: Float32Array, weights: Float32Array, fingers: Complex64Array
    ) -> tuple[Float32Array, Float32Array]:
        """Scores and amplitudes (f,), as of `Preselection`.

        points (k, p, r), weights (k, p); fingers (f, k): their dynamic stiffness [N/m].
        """
        k, p, _ = points.shape
        given = [as_given(each) for each in (points, weights, fingers)]
        found = np.empty((2, self.count), dtype=np.float32)
        arrays = [c_void_p(each.ctypes.data) for each in (*given, *found)]
        on = [ctypes.byref(plate) for plate in self.plates]
        library, lanes = self.kernels.library, self.kernels.lanes
        work = work_space(self.kernels, library.preselection_space(on[0], k, p))
        for first, plate in zip(range(0, self.count, lanes), on, strict=True):
            some = min(lanes, self.count - first)
            library.preselection_scores(*(plate, first, some, k, p), *arrays[:3], work, *arrays[3:])
        return found[0], found[1]
