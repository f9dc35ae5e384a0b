"""What fingers on a plant hold."""

import numpy as np

from model.structure.point_load import footprints_of
from sim.plant.plant import Plant


def held_by_fingers(plant: Plant) -> float:
    """What the springs and masses of the fingers on the plate hold now [J]."""
    q, v = plant.state
    at = plant.reduced.at(footprints_of(plant.contacts))
    springs = np.array([each.stiffness for each in plant.contacts])
    masses = np.array([each.mass for each in plant.contacts])
    return float((springs @ (at @ q) ** 2 + masses @ (at @ v) ** 2) / 2)
