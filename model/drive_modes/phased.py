"""The drive mode `phased`: any amplitude and phase, all ERAs at one frequency, robustly.

The weights are R^-1 conj(h_target), see `model.drive_modes.coherent`. A spring or damper at an ERA
adds a force where the drive acts anyway: without errors the best contrast does not depend on it.
"""

from dataclasses import dataclass

import numpy as np

from model.compiled import structures
from model.compiled.kernels import kernels, run
from model.drive_modes.coherent import (
    LEVEL_RESERVE,
    MAX_GROWTH,
    MAX_MULTIPLIER,
    Coherent,
    CoherentResult,
    Method,
)
from model.drive_modes.forms import Forms

MAX_TARGETS = 4
"""Of a search by the kernel, whose room grows by five for each."""


@dataclass(frozen=True)
class Phased(Coherent):
    """The search for any weights, by a kernel in C where it can be compiled."""

    def tried(self, forms: Forms, method: Method) -> CoherentResult:
        """As of `Coherent`."""
        by = kernels()
        if by is None or len(forms.targets) > MAX_TARGETS:
            return super().tried(forms, method)
        f, q, n, _ = forms.quiet.shape
        is_deep = forms.few is not None and forms.fine is not None
        points = [
            each.shape[2] if each is not None and is_deep else 0 for each in (forms.few, forms.fine)
        ]
        on = structures.GivenForms(
            *(n, len(forms.targets), q, *points, forms.wanted, forms.level_margin),
            *(self.phases[1], self.iterations),
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
        run(by.library.search_stage, on, as_structure(method), rows.ctypes, f, *to)
        return CoherentResult(score, weights, bound, missed)


PHASED = Phased(phases=(1, 5), iterations=8)


def as_structure(method: Method) -> structures.Method:
    """A method as kernels read it."""
    return structures.Method(
        *(method.steps, method.is_limited, method.variance, method.gain),
        *(LEVEL_RESERVE, MAX_GROWTH, MAX_MULTIPLIER),
    )
