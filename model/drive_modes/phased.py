"""The drive mode `phased`: any amplitude and phase, all ERAs at one frequency, robustly.

The weights are R^-1 conj(h_target), see `model.drive_modes.coherent`. A spring or damper at an ERA
adds a force where the drive acts anyway: without errors the best contrast does not depend on it.
"""

from dataclasses import dataclass

from model.compiled.kernels import kernels
from model.drive_modes import phased_kernel
from model.drive_modes.coherent import Coherent, CoherentResult, Method
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
        return phased_kernel.tried(by, self, forms, method)


PHASED = Phased(phases=(1, 5), iterations=8)
