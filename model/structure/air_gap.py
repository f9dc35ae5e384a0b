"""Air in a narrow gap behind a plate: its mass, its friction, and its stiffness.

The plate displaces air, which flows along the gap. In the low reduced frequency model (Zwikker and
Kosten 1949; Beltman, J. Sound Vib. 227 (1999) 555) the pressure is constant across the gap, the
flow profile follows from viscosity, and the temperature from conduction to both walls:

    iωρ b v = -grad p,    iω p / B = -div v - iω w / d,
    1 / b = 1 - tanh(s) / s,               s = (d / 2) sqrt(iωρ / mu),
    1 / B = (1 + (gamma - 1) tanh(t) / t) / (gamma p0),    t = (d / 2) sqrt(iωρ cp / k)

with the mean velocity v over the depth d and the plate's deflection w away from the gap. Slow, b
becomes 12 mu / (iωρ d²) + 6/5, the squeeze film of Reynolds' equation, and air is isothermal; fast,
b = 1, and it is adiabatic. Holds while the gap is narrow compared with waves and with the plate.
"""

import cmath
import math
from dataclasses import dataclass

from model.errors import InputError

# Dry air at 20 °C and 101325 Pa (Lemmon and Jacobsen, Int. J. Thermophys. 25 (2004) 21): density
# [kg/m³], viscosity [Pa s], thermal conductivity [W/(m K)], heat capacity [J/(kg K)], its ratio.
PRESSURE = 101_325.0
DENSITY, VISCOSITY, CONDUCTIVITY, HEAT_CAPACITY, HEAT_RATIO = 1.204, 18.2e-6, 25.9e-3, 1006.0, 1.402


@dataclass(frozen=True)
class AirGap:
    """An air gap between the whole plate and a rigid wall, its depth in m.

    closed: sealed along all edges; otherwise open to the room along all of them.
    """

    depth: float
    closed: bool = False

    def __post_init__(self) -> None:
        """Refuse a depth that is not above zero."""
        if not (math.isfinite(self.depth) and self.depth > 0):
            raise InputError(f"air gap: depth must be above zero, got {self.depth} m")

    def is_narrow(self, frequency: float) -> bool:
        """Whether friction couples modes at a frequency [Hz], which mode by mode leaves out.

        Below five thicknesses of the boundary layer sqrt(2 mu / (rho omega)), between open edges:
        beyond them the response is within 3 % (`benchmarks.layers`).
        """
        layer = math.sqrt(VISCOSITY / (math.pi * DENSITY * frequency))
        return not self.closed and self.depth < 5 * layer

    def inertia(self, frequency: float) -> complex:
        """rho b [kg/m³] at a frequency [Hz]: density of air that friction holds back."""
        wall = self._wall_share(frequency, DENSITY / VISCOSITY)
        return DENSITY / (1 - wall)

    def bulk_modulus(self, frequency: float) -> complex:
        """B [Pa] at a frequency [Hz]: isothermal in the slow limit, adiabatic in the fast."""
        wall = self._wall_share(frequency, DENSITY * HEAT_CAPACITY / CONDUCTIVITY)
        return HEAT_RATIO * PRESSURE / (1 + (HEAT_RATIO - 1) * wall)

    def _wall_share(self, frequency: float, per_frequency: float) -> complex:
        """tanh(s) / s, the share of the depth that walls govern."""
        s = self.depth / 2 * cmath.sqrt(2j * math.pi * frequency * per_frequency)
        return (1.0 if s.real > 300 else cmath.tanh(s)) / s
