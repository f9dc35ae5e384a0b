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

# Depth [thicknesses of the boundary layer] down to which friction hardly couples modes, and down to
# which by some 10 %: responses of the paper's plate and of a panel over 10 um to 10 mm, solved in
# modes and at each frequency.
_OPEN, _SEALED = (5.0, 1.4), (1.0, 0.28)


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

    def coupling_error(self, frequency: float) -> float:
        """Error of the response where friction couples modes, which is left out, at least [-].

        At a frequency [Hz], by thicknesses of the boundary layer sqrt(2 mu / (rho omega)): within
        3 % over a deeper open gap, 5 % over a deeper sealed one, where it is 0 here; then 10 %, and
        in a gap too narrow for modes half of the response and more.
        """
        layers = self.depth / math.sqrt(VISCOSITY / (math.pi * DENSITY * frequency))
        within, modal = _SEALED if self.closed else _OPEN
        return 0.0 if layers >= within else 0.1 if layers >= modal else 0.5

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
