"""Whether a layout supports the plate: lowest mode, weight on every ERA, level kept."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from model.arrays import FloatArray
from model.rig.rig import Rig
from model.structure.actuator import Era
from model.structure.plate import Plate
from model.structure.point_load import PointLoad
from model.structure.support import rigid_body_frequencies

GRAVITY = 9.81  # m/s²
DEFAULT_LOWEST = 20.0
"""Lowest natural frequency [Hz] of the plate on its ERAs: it sags by 0.6 mm under its weight."""

ROUNDING = 1e-9
"""Share of the mean load below which a pull is none: an ERA may carry nothing."""

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
        pulled = -float(loads.min() / loads.mean())
        return max(0.0, 1 - frequency / self.lowest) + (pulled if pulled > ROUNDING else 0.0)


def static_loads(rig: Rig, eras: Sequence[Era]) -> FloatArray:
    """Weight [N] on each ERA, and then on each spring among the masses, of the rigid plate."""
    attached = [*map(PointLoad.of_era, eras), *rig.masses]
    places = np.array([[each.x, each.y] for each in attached])
    stiffness = np.array([each.stiffness for each in attached])
    mass = np.array([each.mass for each in attached])
    return static_loads_of(rig.plate, places, stiffness, mass)[stiffness > 0]


def static_loads_of(
    plate: Plate, places: FloatArray, stiffness: FloatArray, mass: FloatArray
) -> FloatArray:
    """Weight [N] on each spring, (..., n), of the rigid plates of many layouts at once.

    places [m] (..., n, 2), stiffness [N/m] and mass [kg] (..., n) of what is attached, of which at
    least three springs are not in one line. Sinking w = q0 + q1 (x - L/2) + q2 (y - W/2) with
    K q = sum of weights p, reactions k p' q.
    """
    tilts = places / [plate.length, plate.width] - 0.5
    p = np.concatenate([np.ones_like(tilts[..., :1]), tilts], axis=-1)
    K = (p * stiffness[..., None]).swapaxes(-1, -2) @ p
    weight = GRAVITY * (p * mass[..., None]).sum(axis=-2)
    weight[..., 0] += GRAVITY * plate.mass
    q = np.linalg.solve(K, weight[..., None])
    return np.asarray(stiffness * (p @ q)[..., 0])
