"""What fingers on a plant hold."""

import numpy as np

from model.structure.attachments import footprints_of
from sim.plant.plant import Plant


def held_by_fingers(plant: Plant) -> float:
    """What pulps, joints and masses of the fingers on the plate hold now [J]."""
    at = plant.reduced.at(footprints_of(plant.contacts.values()))
    skin, skin_speed = (at @ part for part in plant.state)
    phalanx, phalanx_speed = plant.phalanges
    held = 0.0
    for number, contact in enumerate(plant.contacts.values()):
        tip = contact.fingertip
        held += tip.stiffness * (skin[number] - phalanx[number]) ** 2
        held += tip.joint_stiffness * phalanx[number] ** 2
        held += tip.contact_mass * skin_speed[number] ** 2
        held += tip.phalanx_mass * phalanx_speed[number] ** 2
    return float(held / 2)


def power_lost_in_fingers(plant: Plant) -> float:
    """What the dampers of the fingers on the plate take now [W]."""
    at = plant.reduced.at(footprints_of(plant.contacts.values()))
    speed, phalanx_speed = at @ plant.state[1], plant.phalanges[1]
    pulps = np.array([each.fingertip.damping for each in plant.contacts.values()])
    joints = np.array([each.fingertip.joint_damping for each in plant.contacts.values()])
    return float(pulps @ (speed - phalanx_speed) ** 2 + joints @ phalanx_speed**2)
