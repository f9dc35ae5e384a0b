"""The weights of `model.drive_modes.coherent` by a kernel in C."""

import numpy as np

from model.compiled import structures
from model.compiled.kernels import Kernels, run
from model.drive_modes.coherent import (
    LEVEL_RESERVE,
    MAX_GROWTH,
    MAX_MULTIPLIER,
    Coherent,
    CoherentResult,
    Method,
)
from model.drive_modes.forms import Forms


def given(method: Method) -> structures.Method:
    """A method as kernels read it."""
    return structures.Method(
        *(method.steps, method.is_limited, method.variance, method.gain),
        *(LEVEL_RESERVE, MAX_GROWTH, MAX_MULTIPLIER),
    )


def tried(kernels: Kernels, coherent: Coherent, forms: Forms, method: Method) -> CoherentResult:
    """As `Coherent.tried`."""
    f, q, n, _ = forms.quiet.shape
    is_deep = forms.few is not None and forms.fine is not None
    points = [
        each.shape[2] if each is not None and is_deep else 0 for each in (forms.few, forms.fine)
    ]
    on = structures.GivenForms(
        *(n, len(forms.targets), q, *points, forms.wanted, forms.level_margin),
        *(coherent.phases[1], coherent.iterations),
    )
    on.point(
        of_targets=forms.targets.swapaxes(0, 1),
        target_power=forms.target_power.swapaxes(0, 1),
        quiet=forms.quiet,
        threshold=forms.threshold,
        few_fields=forms.few,
        fine_fields=forms.fine,
    )
    weights, rows = np.empty((f, n), dtype=np.complex64), np.arange(f, dtype=np.int32)
    score, missed, bound = measures = np.empty((3, f), dtype=np.float32)
    to = [each.ctypes for each in (weights, *measures)]
    run(kernels.library.search_stage, on, given(method), rows.ctypes, f, *to)
    return CoherentResult(score, weights, bound, missed)
