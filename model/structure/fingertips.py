"""Fingertips, hands and objects that rest on the plate.

A fingertip is a contact mass that moves with the plate, and a spring and a damper (the pulp)
between the plate and the phalanx, which is a mass on a joint. The phalanx is not at rest: at 60,
100 and 250 Hz the real part of the dynamic stiffness is 69, -87 and -358 N/m; with a phalanx at
rest it would be 972, 921 and 507 N/m. docs/concepts/people.md states the uncertainty of these
values.

The load of a finger is relative to the rig's fingertip. A heavier load is a hand, which rests on
several patches.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import ClassVar

import numpy as np

from model.arrays import ComplexArray, FloatArray, Point
from model.errors import InputError, expect_values
from registry.limits import HAND_LOAD, MAX_FINGER_LOAD

MIN_LOAD = 0.1
"""Smallest load of a finger relative to the rig's fingertip; the largest is MAX_FINGER_LOAD."""

HAND_STD = 1.1
"""Standard deviation of the logarithm of the load of each patch of a hand, a factor of 3."""

HAND_PATCHES = ((-0.0125, -0.0125), (0.0125, -0.0125), (-0.0125, 0.0125), (0.0125, 0.0125))
"""Patches of a hand of `HAND_LOAD`, relative to its center [m]; each carries a quarter of the load.

The distances between the patches grow with the square root of the hand's load.
"""

OBJECT_STIFFNESS, OBJECT_DAMPING_RATIO = 1e5, 0.1
"""Assumed contact stiffness [N/m] and damping ratio of an object on the plate, such as a cup."""


@dataclass(frozen=True)
class Fingertip:
    """Load of a fingertip; the defaults are for a lightly pressing finger."""

    stiffness: float = 1000.0
    """Stiffness of the pulp [N/m]."""
    damping: float = 2.0
    """Damping of the pulp [N s/m]."""
    contact_mass: float = 0.0002
    """Mass that moves with the plate [kg]."""
    phalanx_mass: float = 0.005
    """Mass of the bone behind the pulp [kg]."""
    joint_stiffness: float = 500.0
    """Stiffness of the joint that holds the bone to the rest plane [N/m]."""
    joint_damping: float = 2.0
    """Damping of that joint [N s/m]."""

    def __post_init__(self) -> None:
        """Reject values that are negative or not finite, an undamped pulp, and no phalanx."""
        expect_values(
            self,
            "fingertip",
            above="damping phalanx_mass",
            at_least="stiffness contact_mass joint_stiffness joint_damping",
        )

    def dynamic_stiffness(self, omega: FloatArray | ComplexArray) -> ComplexArray:
        """Force on the plate per displacement of the contact at omega [rad/s], of its shape [N/m].

        omega can be complex, with time dependence exp(i omega t). D = -omega² m_c + Z_p Z_b / (Z_p
        + Z_b), with Z_p = k + i omega c of the pulp and Z_b = k_j + i omega c_j - omega² m_p of the
        phalanx on its joint.
        """
        w = np.asarray(omega)
        pulp = self.stiffness + 1j * w * self.damping
        phalanx = self.joint_stiffness + 1j * w * self.joint_damping - w**2 * self.phalanx_mass
        total = pulp + phalanx
        # At omega = 0, a pulp and a joint without stiffness transmit no force.
        in_series = pulp * phalanx / np.where(total == 0, 1.0, total)
        return in_series - w**2 * self.contact_mass

    def scaled(self, factor: float) -> "Fingertip":
        """Scale the contact of the fingertip by a factor: its pulp and its contact mass.

        Phalanx, joint, and the ratio of damping to stiffness of the pulp stay the same.
        """
        return replace(
            self,
            stiffness=factor * self.stiffness,
            damping=factor * self.damping,
            contact_mass=factor * self.contact_mass,
        )

    def multiplied(self, factor: float) -> "Fingertip":
        """Multiply the dynamic stiffness by a factor at every frequency."""
        return Fingertip(**{key: factor * value for key, value in asdict(self).items()})

    def under(self, load: float) -> "Fingertip":
        """Return a finger with a load, or one patch of a hand with this load.

        A hand has a larger mass behind each patch as well.
        """
        if load <= MAX_FINGER_LOAD:
            return self.scaled(load)
        return self.multiplied(load / len(HAND_PATCHES))


@dataclass(frozen=True)
class FingertipLoad:
    """A fingertip that rests on the plate at the point x, y [m]."""

    x: float
    y: float
    fingertip: Fingertip
    foot: ClassVar[float] = 0.0

    def dynamic_stiffness(self, omega: FloatArray) -> ComplexArray:
        """Dynamic stiffness [N/m] at omega [rad/s], of the same shape."""
        return self.fingertip.dynamic_stiffness(omega)


def object_load(mass: float) -> Fingertip:
    """Return the load of an object of a mass [kg] on the plate: the mass on a contact spring."""
    damping = 2 * OBJECT_DAMPING_RATIO * math.sqrt(OBJECT_STIFFNESS * mass)
    return Fingertip(OBJECT_STIFFNESS, damping, 0.0, mass, 0.0, 0.0)


def check_loads(loads: Iterable[float], *, highest: float = MAX_FINGER_LOAD) -> None:
    """Raise InputError for a load, relative to a fingertip, that no finger has.

    highest: MAX_HAND_LOAD where hands may rest.
    """
    for load in loads:
        if not MIN_LOAD <= load <= highest:  # False for NaN
            raise InputError(
                f"load must be between {MIN_LOAD:g} and {highest:g} times the rig's fingertip, "
                f"got {load}"
            )


def with_patches(
    contacts: Sequence[Point], loads: Sequence[float], size: Point
) -> tuple[list[Point], list[float]]:
    """Return positions [m] and loads of contacts on a plate of a size [m], with hands as patches.

    The first patch of a hand replaces the hand; its other patches follow all contacts.
    """
    positions = [*contacts]
    position_loads = [*loads]
    for number, (contact, load) in enumerate(zip(contacts, loads, strict=True)):
        if load > MAX_FINGER_LOAD:
            offsets = math.sqrt(load / HAND_LOAD) * np.array(HAND_PATCHES)
            on_plate = np.clip(contact + offsets, 0.0, size)
            patches = [(x, y) for x, y in on_plate.tolist()]
            positions[number] = patches[0]
            positions += patches[1:]
            position_loads += [load] * (len(patches) - 1)
    return positions, position_loads


def fingertip_loads(
    fingertip: Fingertip | None, contacts: Sequence[Point], loads: Sequence[float] = ()
) -> list[FingertipLoad]:
    """Return the fingertips at contacts [m]; an empty list if fingertips are massless (None).

    loads: relative to the fingertip, empty for 1 each.
    """
    if fingertip is None:
        return []
    tips = [fingertip.under(load) for load in loads] or [fingertip] * len(contacts)
    return [FingertipLoad(x, y, tip) for (x, y), tip in zip(contacts, tips, strict=True)]
