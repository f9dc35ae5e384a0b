"""An isotropic, linear material."""

import math
from dataclasses import dataclass

from model.errors import InputError


@dataclass(frozen=True)
class Material:
    """An isotropic, linear material.

    E: Young's modulus [Pa]; rho: density [kg/m³]; nu: Poisson's ratio.
    """

    name: str
    E: float
    rho: float
    nu: float

    def __post_init__(self) -> None:
        """Refuse values of no isotropic solid."""
        for key, value in (("E", self.E), ("rho", self.rho)):
            if not (math.isfinite(value) and value > 0):
                raise InputError(f"material {self.name}: {key} must be above zero, got {value}")
        if not -1 < self.nu < 0.5:
            raise InputError(
                f"material {self.name}: nu must be between -1 and 0.5, got {self.nu} (most solids: "
                "0.2 to 0.45)"
            )

    @property
    def shear_modulus(self) -> float:
        """G = E / 2 (1 + nu) [Pa]."""
        return self.E / (2 * (1 + self.nu))
