"""The electrostatic resonant actuator (ERA): spring, damper and bolt between plate and base."""

import math
from dataclasses import dataclass

from model.errors import InputError


@dataclass(frozen=True)
class Era:
    """One ERA under the plate; its base moves y(t) = amplitude sin(omega t + phase).

    x, y: where it holds the plate [m]; stiffness k_b [N/m]; damping c [N s/m]; bolt_mass m_b [kg];
    stroke: the largest base amplitude [m]. An ERA that is not driven still supports and damps.
    """

    name: str
    x: float
    y: float
    stiffness: float
    damping: float
    bolt_mass: float
    stroke: float

    def __post_init__(self) -> None:
        """Refuse values that no ERA can have."""
        for key in ("x", "y", "stiffness", "damping", "bolt_mass", "stroke"):
            if not math.isfinite(getattr(self, key)):
                raise InputError(f"ERA {self.name}: {key} is {getattr(self, key)}, not a number")
        for key in ("stiffness", "stroke"):
            if getattr(self, key) <= 0:
                raise InputError(
                    f"ERA {self.name}: {key} is {getattr(self, key)}, must be above zero"
                )
        for key in ("damping", "bolt_mass"):
            if getattr(self, key) < 0:
                raise InputError(f"ERA {self.name}: {key} is {getattr(self, key)}, below zero")


def damping_from_ratio(
    ratio: float, *, stiffness: float, plate_mass: float, era_count: int
) -> float:
    """Damping c = 2 zeta sqrt(k_b m_plate / n_eras) [N s/m] of an ERA that carries its share."""
    return 2 * ratio * math.sqrt(stiffness * plate_mass / era_count)
