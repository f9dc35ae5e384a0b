"""Whether a layout supports the plate: lowest mode, and weight on every ERA."""

from collections.abc import Sequence

from model.rig.rig import Rig
from model.structure.attachments import Era
from model.structure.support import rigid_body_frequencies, static_loads

DEFAULT_LOWEST = 20.0
"""Lowest natural frequency [Hz] of the plate on its ERAs: it sags by 0.6 mm under its weight."""

MIN_SUPPORTING = 3
"""ERAs, and other mounts, that can support a plate."""

_ROUNDING = 1e-9  # share of the mean load below which a pull is none: an ERA may carry nothing


def shortfall(rig: Rig, eras: Sequence[Era], *, lowest: float) -> float:
    """How far ERAs are from supporting a rig's plate, 0 if they do.

    lowest [Hz]: least rigid-body frequency. No mount may be pulled upwards by the plate's weight,
    so that the centre of mass is within them and the plate does not tip.
    """
    frequency = float(rigid_body_frequencies(rig.plate, eras, loads=rig.masses)[0])
    if frequency < 1e-3:
        return 2.0
    loads = static_loads(rig.plate, eras, loads=rig.masses)
    pulled = -float(loads.min() / loads.mean())
    return max(0.0, 1 - frequency / lowest) + (pulled if pulled > _ROUNDING else 0.0)
