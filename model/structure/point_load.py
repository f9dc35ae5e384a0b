"""Passive loads of the plate at a point: a mass, a resting finger."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from model.arrays import FloatArray
from model.errors import InputError


@dataclass(frozen=True)
class PointLoad:
    """A spring [N/m] and a damper [N s/m] to the ground, and a mass [kg], at x, y [m]."""

    x: float
    y: float
    stiffness: float = 0.0
    damping: float = 0.0
    mass: float = 0.0

    def __post_init__(self) -> None:
        """Refuse values that are not finite, and loads that add energy."""
        for key in ("x", "y", "stiffness", "damping", "mass"):
            value = getattr(self, key)
            if not math.isfinite(value):
                raise InputError(f"point load: {key} must be finite, got {value}")
            if key not in ("x", "y") and value < 0:
                raise InputError(f"point load: {key} must not be negative, got {value}")


def load_positions(loads: Sequence[PointLoad]) -> FloatArray:
    """Positions of loads [m], (n, 2)."""
    return np.array([[load.x, load.y] for load in loads], dtype=float).reshape(-1, 2)
