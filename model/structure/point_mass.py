"""A point mass: something small that the plate carries and that moves with it."""

import math
from dataclasses import dataclass

from model.errors import InputError


@dataclass(frozen=True)
class PointMass:
    """A mass [kg] on the plate at x, y [m]: a camera, a connector, a bracket.

    It follows the deflection there; its extent, its rotary inertia and whatever is springy in its
    mounting are not modelled.
    """

    x: float
    y: float
    mass: float

    def __post_init__(self) -> None:
        """Refuse what is no place or no mass."""
        for key in ("x", "y", "mass"):
            if not math.isfinite(getattr(self, key)):
                raise InputError(f"point mass: {key} is {getattr(self, key)}, not a number")
        if self.mass < 0:
            raise InputError(f"point mass: mass is {self.mass} kg, below zero")
