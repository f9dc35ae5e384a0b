"""Passive loads of the plate at a point: what they have in common, and a mass on a mount."""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from model.arrays import ComplexArray, FloatArray
from model.errors import InputError
from model.structure.actuator import Era


class Located(Protocol):
    """What is attached to the plate at x, y [m], on a disc of radius foot [m], 0 for a point."""

    @property
    def x(self) -> float:
        """Position along the length [m]."""

    @property
    def y(self) -> float:
        """Position along the width [m]."""

    @property
    def foot(self) -> float:
        """Radius of the disc on which it acts [m]."""


class Load(Located, Protocol):
    """A passive load: a point mass, a fingertip."""

    def dynamic_stiffness(self, omega: FloatArray) -> ComplexArray:
        """Force on it per displacement of the plate [N/m] at omega [rad/s], of the same shape."""


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

    def dynamic_stiffness(self, omega: FloatArray) -> ComplexArray:
        """D = k + i omega c - omega² m [N/m], of the shape of omega [rad/s]."""
        return np.asarray(self.stiffness + 1j * omega * self.damping - omega**2 * self.mass)

    @classmethod
    def of_era(cls, era: Era) -> "PointLoad":
        """An ERA at rest, as a load of the plate."""
        return cls(era.x, era.y, era.stiffness, era.damping, era.bolt_mass, era.foot)


def footprints_of(*attached: Iterable[Located]) -> FloatArray:
    """Footprints x, y, radius [m] of ERAs and loads, one group after the other, (n, 3)."""
    places = [[each.x, each.y, each.foot] for group in attached for each in group]
    return np.array(places, dtype=float).reshape(-1, 3)
