"""The drive mode `phased`: any amplitude and phase, all ERAs at one frequency, robustly.

The weights are R^-1 conj(h_target), see `model.drive_modes.coherent`. A spring or damper at an ERA
adds a force where the drive acts anyway: without errors the best contrast does not depend on it.
"""

from dataclasses import dataclass

from model.compiled.kernels import kernels
from model.drive_modes import phased_kernel
from model.drive_modes.coherent import Coherent, CoherentResult
from model.drive_modes.forms import Forms


@dataclass(frozen=True)
class Phased(Coherent):
    """The search for any weights, by a kernel in C for one target."""

    def search(self, forms: Forms, min_score: float) -> CoherentResult:
        """Find the best weights at each frequency that can have the best score of all."""
        by = kernels()
        if by is None or len(forms.targets) > 1:
            return super().search(forms, min_score)
        return phased_kernel.search(by, forms, min_score)

    def search_all(self, forms: Forms) -> CoherentResult:
        """Find the best weights at every frequency, none pruned and none raised to the level."""
        by = kernels()
        if by is None or len(forms.targets) > 1:
            return super().search_all(forms)
        return phased_kernel.search_all(by, forms)


PHASED = Phased(phases=(1, 5), iterations=8)
