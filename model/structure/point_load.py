"""Passive loads of the plate at a point: a mass, a resting finger."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from model.arrays import FloatArray
from model.errors import InputError
from model.structure.actuator import Era


@dataclass(frozen=True)
class PointLoad:
    """A spring [N/m] and a damper [N s/m] to the ground, and a mass [kg], at x, y [m].

    foot [m]: radius of the disc on which it acts, 0 for a point. It follows the mean deflection;
    its rotary inertia is not modelled.
    """

    x: float
    y: float
    stiffness: float = 0.0
    damping: float = 0.0
    mass: float = 0.0
    foot: float = 0.0

    def __post_init__(self) -> None:
        """Refuse values that are not finite, and loads that add energy."""
        for key in ("x", "y", "stiffness", "damping", "mass", "foot"):
            value = getattr(self, key)
            if not math.isfinite(value):
                raise InputError(f"point load: {key} must be finite, got {value}")
            if key not in ("x", "y") and value < 0:
                raise InputError(f"point load: {key} must not be negative, got {value}")

    @property
    def numbers(self) -> dict[str, float]:
        """Its values by name, without stiffness and damping where both are zero."""
        mass = {"x": self.x, "y": self.y, "mass": self.mass, "foot": self.foot}
        mount = {"stiffness": self.stiffness, "damping": self.damping}
        return mass | mount if any(mount.values()) else mass

    @classmethod
    def of_era(cls, era: Era) -> "PointLoad":
        """An ERA at rest, as a load of the plate."""
        return cls(era.x, era.y, era.stiffness, era.damping, era.bolt_mass, era.foot)


def footprints_of(*attached: Sequence[Era] | Sequence[PointLoad]) -> FloatArray:
    """Footprints x, y, radius [m] of ERAs and loads, one group after the other, (n, 3)."""
    places = [[each.x, each.y, each.foot] for group in attached for each in group]
    return np.array(places, dtype=float).reshape(-1, 3)
