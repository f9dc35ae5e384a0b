"""Whether a layout supports the plate: lowest mode, weight on every ERA, level kept."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from model.arrays import FloatArray
from model.rig.rig import Rig
from model.structure.actuator import Era
from model.structure.point_load import PointLoad
from model.structure.support import rigid_body_frequencies

GRAVITY = 9.81  # m/s²
DEFAULT_LOWEST = 20.0
"""Lowest natural frequency [Hz] of the plate on its ERAs: it sags by 0.6 mm under its weight."""

MIN_SUPPORTING = 3
"""ERAs, and other mounts, that can support a plate."""


@dataclass(frozen=True)
class SupportRule:
    """What supports a rig's plate.

    lowest [Hz]: least rigid-body frequency on the mounts. No mount may be pulled upwards by the
    plate's weight, so that the centre of mass is within them and the plate does not tip.
    """

    rig: Rig
    lowest: float = DEFAULT_LOWEST

    def shortfall(self, eras: Sequence[Era]) -> float:
        """How far ERAs are from supporting the plate, 0 if they do."""
        frequency = float(rigid_body_frequencies(self.rig.plate, eras, loads=self.rig.masses)[0])
        if frequency < 1e-3:
            return 2.0
        loads = static_loads(self.rig, eras)
        even = float(loads.mean())
        pulled = max(0.0, -float(loads.min() / even))
        return max(0.0, 1 - frequency / self.lowest) + pulled


def static_loads(rig: Rig, eras: Sequence[Era]) -> FloatArray:
    """Weight [N] on each ERA, and then on each spring among the masses, of the rigid plate.

    Sinking w = q0 + q1 (x - L/2) + q2 (y - W/2) with K q = sum of weights p, reactions k p' q.
    """
    springs = [*map(PointLoad.of_era, eras), *(load for load in rig.masses if load.stiffness > 0)]
    plate = rig.plate

    def basis(at: Sequence[PointLoad]) -> FloatArray:
        places = np.array([[each.x, each.y] for each in at]).reshape(-1, 2)
        return np.column_stack([np.ones(len(at)), places / [plate.length, plate.width] - 0.5])

    p = basis(springs)
    stiffness = np.array([each.stiffness for each in springs])
    masses = [*map(PointLoad.of_era, eras), *rig.masses]
    weights = GRAVITY * np.array([each.mass for each in masses])
    weight = GRAVITY * plate.mass * np.array([1.0, 0.0, 0.0]) + weights @ basis(masses)
    q = np.linalg.lstsq((p.T * stiffness) @ p, weight, rcond=None)[0]
    return np.asarray(stiffness * (p @ q))
