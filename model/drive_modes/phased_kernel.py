"""The search of `model.drive_modes.coherent` for one target and any weights, by its kernel in C."""

import ctypes
from ctypes import c_float, c_int, c_size_t, c_void_p
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from model.arrays import Complex64Array, Float32Array, IntArray
from model.compiled.kernels import Kernels
from model.compiled.lanes import as_given, work_space
from model.drive_modes.coherent import (
    LAWSON_STEPS,
    LEVEL_RELAXATION,
    LEVEL_RESERVE,
    LIMITED_STEPS,
    MAX_GROWTH,
    MAX_MULTIPLIER,
    CoherentResult,
)
from model.drive_modes.forms import Forms

_ARRAYS = ("targets", "target_power", "quiet", "threshold", "few", "fine")


class _Forms(ctypes.Structure):
    _fields_ = (
        *((name, c_int) for name in ("n", "q", "few", "fine")),
        *((name, c_float) for name in ("wanted", "margin")),
        *((f"of_{name}", c_void_p) for name in _ARRAYS),
    )


class _Method(ctypes.Structure):
    """Weights that are tried: how many at each frequency, the rest as in `phased_search.c`."""

    _fields_ = (
        *((name, c_int) for name in ("steps", "limited")),
        *((name, c_float) for name in ("variance", "gain", "reserve", "growth", "most")),
    )


_ONE_FINGER, _SEVERAL = _Method(steps=1), _Method(steps=1 + LAWSON_STEPS)
_WITHIN_STROKE = (
    _Method(
        steps=LIMITED_STEPS,
        limited=1,
        gain=1,
        reserve=LEVEL_RESERVE,
        growth=MAX_GROWTH,
        most=MAX_MULTIPLIER,
    ),
    *(_Method(steps=1, variance=sigma**2, gain=gain) for sigma, gain in LEVEL_RELAXATION),
)


def search(kernels: Kernels, forms: Forms, min_score: float) -> CoherentResult:
    """As `Coherent.search`, none pruned."""
    kernel = _Kernel(kernels, forms)
    found = kernel.tried(np.arange(forms.frequency_count), _steps(forms))
    score, missed = found.score, found.missed
    best = max(min_score, float(score.max()))
    open_ = _level_limited(score, missed, best)
    for method in _WITHIN_STROKE:
        if len(open_) == 0:
            break
        further = kernel.tried(open_, method)
        score[open_], found.weights[open_] = further.score, further.weights
        missed[open_] = np.maximum(missed[open_], further.missed)
        best = max(best, float(score.max()))
        open_ = _level_limited(score, missed, best)
    return CoherentResult(score, found.weights, found.bound, len(open_) > 0)


def search_all(kernels: Kernels, forms: Forms) -> CoherentResult:
    """As `Coherent.search_all`."""
    found = _Kernel(kernels, forms).tried(np.arange(forms.frequency_count), _steps(forms))
    open_ = _level_limited(found.score, found.missed, float(found.score.max()))
    return CoherentResult(found.score, found.weights, found.bound, len(open_) > 0)


def _steps(forms: Forms) -> _Method:
    return _SEVERAL if forms.quiet.shape[1] > 1 else _ONE_FINGER


def _level_limited(score: Float32Array, missed: Float32Array, best: float) -> IntArray:
    """Frequencies without weights that reach the level, but of a better score than the best."""
    return np.asarray(((score == 0) & (missed > best)).nonzero()[0])


@dataclass(frozen=True, eq=False)
class _Tried:
    """The best weights (n, eras) that reach the level and their score (n,), 0 where none do.

    missed (n,): the best score of those that miss it; bound (n,): upper bound of the score.
    """

    weights: Complex64Array
    score: Float32Array
    missed: Float32Array
    bound: Float32Array


class _Kernel:
    """The kernel for forms of one target."""

    def __init__(self, kernels: Kernels, forms: Forms) -> None:
        fields = () if forms.few is None or forms.fine is None else (forms.few, forms.fine)
        given = (forms.targets[0], forms.target_power[0], forms.quiet, forms.threshold, *fields)
        # Kept, since the kernel reads them.
        self._arrays = [as_given(each) for each in given]
        _, q, n, _ = forms.quiet.shape
        points = [each.shape[2] for each in fields] or [0, 0]
        pointers = [each.ctypes.data for each in self._arrays]
        self._forms = ctypes.byref(
            _Forms(n, q, *points, forms.wanted, forms.level_margin, *pointers)
        )
        library = kernels.library
        library.phased_search_space.restype = c_size_t
        self._space = library.phased_search_space(self._forms)
        self._kernels, self._eras = kernels, n

    def tried(self, rows: IntArray, method: _Method) -> _Tried:
        """What a method finds at frequencies, by index (n,)."""
        count = len(rows)
        weights = np.empty((count, self._eras), dtype=np.complex64)
        measures = np.empty((3, count), dtype=np.float32)
        at = np.ascontiguousarray(rows, dtype=np.int32)
        self._kernels.library.phased_search(
            *(self._forms, ctypes.byref(method)),
            *(_at(at), count, work_space(self._kernels, self._space)),
            *(_at(each) for each in (weights, *measures)),
        )
        return _Tried(weights, *measures)


def _at(array: NDArray[Any]) -> c_void_p:
    return c_void_p(array.ctypes.data)
