"""A point mass: a small object fixed to the plate."""

import math
from dataclasses import dataclass

from model.errors import InputError


@dataclass(frozen=True)
class PointMass:
    """A mass [kg] on the plate at x, y [m]: a camera, a connector, a bracket.

    It follows the deflection; its extent, rotary inertia and elastic mounting are not modelled.
    """

    x: float
    y: float
    mass: float

    def __post_init__(self) -> None:
        """Refuse values that are not finite, and negative mass."""
        for key in ("x", "y", "mass"):
            if not math.isfinite(getattr(self, key)):
                raise InputError(f"point mass: {key} must be finite, got {getattr(self, key)}")
        if self.mass < 0:
            raise InputError(f"point mass: mass must not be negative, got {self.mass} kg")
