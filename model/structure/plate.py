"""Touch plate: its layers, the air behind it, and its bending stiffness.

Air in a narrow gap behind the plate flows along it. In the low reduced frequency model (Zwikker and
Kosten 1949; Beltman, J. Sound Vib. 227 (1999) 555) the pressure is constant across the gap, the
flow profile follows from viscosity, and the temperature from conduction to both walls:

    iωρ b v = -grad p,    iω p / B = -div v - iω w / d,
    1 / b = 1 - tanh(s) / s,               s = (d / 2) sqrt(iωρ / mu),
    1 / B = (1 + (gamma - 1) tanh(t) / t) / (gamma p0),    t = (d / 2) sqrt(iωρ cp / k)

with the mean velocity v over the depth d and the plate's deflection w away from the gap. In slow
motion, b is 12 mu / (iωρ d²) + 6/5, the squeeze film of Reynolds' equation, and the air is
isothermal; in fast motion b = 1, and it is adiabatic. The model holds while the gap is narrow
compared with waves and with the plate.

Bending of a laminate: `model.structure.laminate_bending`. Not modeled: air between loose layers.
"""

import cmath
import math
from bisect import bisect_left
from dataclasses import dataclass, field, fields, replace
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from model.arrays import FloatArray
from model.errors import MAX_VALUE, InputError, expect_between, expect_values
from model.structure.material import Material
from model.structure.surface import EDGES, Surface, is_within


class Bond(StrEnum):
    """How the layers of a laminate hold together."""

    FULL = "full"
    NONE = "none"


class Sheet:
    """A sheet of a material, with its thickness [m]."""

    material: Material
    thickness: float

    @property
    def surface_density(self) -> float:
        """Mass per area [kg/m²]."""
        return self.material.rho * self.thickness

    @property
    def flexural_rigidity(self) -> float:
        """Flexural rigidity D = E h³ / 12 (1 - nu²) [N m], paper Eq. 7.

        For a board, the geometric mean along and across its length.
        """
        return math.sqrt(self.material.shares.e2) * self._along

    def rigidity_towards(self, cos2: FloatArray | float) -> FloatArray | float:
        """Flexural rigidity [N m] of straight waves, by the squared cosine c² of their direction.

        D1 c⁴ + 2 (nu12 D2 + 2 D12) c² s² + D2 s⁴, with the direction relative to the length.
        """
        d1, mixed, d2 = self._rigidities
        sin2 = 1 - cos2
        return d1 * cos2**2 + 2 * mixed * cos2 * sin2 + d2 * sin2**2

    @property
    def least_rigidity(self) -> float:
        """Flexural rigidity [N m] in the direction of the shortest waves."""
        d1, mixed, d2 = self._rigidities
        if mixed >= min(d1, d2):
            return min(d1, d2)
        return (d1 * d2 - mixed**2) / (d1 - 2 * mixed + d2)  # in an oblique direction

    @property
    def _along(self) -> float:
        """D1 [N m], along the length."""
        return self.material.E * self.thickness**3 / (12 * self.material.plane_stress)

    @property
    def _rigidities(self) -> tuple[float, float, float]:
        """D1, nu12 D2 + 2 D12, and D2 [N m]."""
        material = self.material
        shares = material.shares
        mixed = material.nu * shares.e2 + 2 * (shares.g12 * material.plane_stress)
        return self._along, self._along * mixed, self._along * shares.e2


@dataclass(frozen=True)
class LaminateLayer(Sheet):
    """One layer of a laminate; thickness [m]."""

    material: Material
    thickness: float
    loss_factor: float = 0.0
    """Loss factor eta of its modulus E (1 + i eta)."""

    by_frequency: tuple[tuple[float, float, float], ...] = ()
    """Rows of frequency [Hz], ascending, factor of E, and loss factor, which replaces loss_factor.

    Linear in the logarithms of frequency and factor, constant outside.
    """

    def __post_init__(self) -> None:
        """Reject a thickness that is not above zero, and rows without a valid modulus."""
        expect_values(self, "layer", above="thickness")
        previous = 0.0
        for frequency, factor, loss in self.by_frequency:
            if not (previous < frequency <= MAX_VALUE and 0 < factor <= MAX_VALUE and loss >= 0):
                raise InputError(
                    "layer: by_frequency must have rows of ascending frequencies above 0 Hz, "
                    f"factors above 0 and loss factors, got ({frequency}, {factor}, {loss})"
                )
            previous = frequency

    def modulus(self, frequency: float) -> complex:
        """E (1 + i eta) [Pa] at a frequency [Hz]."""
        rows = self.by_frequency
        if not rows:
            return self.material.E * (1 + 1j * self.loss_factor)
        above = bisect_left(rows, (frequency,))
        low, low_factor, low_loss = rows[max(above - 1, 0)]
        high, high_factor, high_loss = rows[min(above, len(rows) - 1)]
        share = 0.0
        if low < frequency <= high:
            share = math.log(frequency / low) / math.log(high / low)
        factor = low_factor * math.pow(high_factor / low_factor, share)
        loss = low_loss + share * (high_loss - low_loss)
        return self.material.E * factor * (1 + 1j * loss)

    @property
    def is_elastic(self) -> bool:
        """Whether its modulus is real and the same at all frequencies."""
        return not self.by_frequency and not self.loss_factor


@dataclass(frozen=True)
class Laminate:
    """Layers from one face to the other."""

    layers: tuple[LaminateLayer, ...]
    bond: Bond = Bond.FULL

    def __post_init__(self) -> None:
        """Reject a laminate without layers, with a grain, or with losses in layers that slide."""
        if not self.layers:
            raise InputError("laminate: must have at least one layer")
        for layer in self.layers:
            if layer.material.orthotropy:
                raise InputError(
                    f"laminate: layers must be isotropic, got {layer.material.name}; give a board "
                    "by thickness and material of the plate"
                )
        if self.bond is Bond.NONE and not all(layer.is_elastic for layer in self.layers):
            raise InputError(
                "laminate: layers must be without loss_factor and by_frequency with bond none; "
                "give the loss factor of the plate"
            )

    @property
    def thickness(self) -> float:
        """Thickness of all layers together [m]."""
        return sum(layer.thickness for layer in self.layers)

    @property
    def surface_density(self) -> float:
        """Mass per area of all layers [kg/m²]."""
        return sum(layer.surface_density for layer in self.layers)

    def scaled(self, *, modulus: float = 1.0, thickness: float = 1.0) -> "Laminate":
        """The laminate with all moduli and all thicknesses times a factor."""
        layers = list[LaminateLayer]()
        for layer in self.layers:
            material = replace(layer.material, E=modulus * layer.material.E)
            scaled = replace(layer, material=material, thickness=thickness * layer.thickness)
            layers.append(scaled)
        return replace(self, layers=tuple(layers))


class SurroundingAir(StrEnum):
    """Open air that moves with the plate (`model.spectral.surrounding_air`)."""

    BOTH = "both sides"
    """Around free edges, between front and back."""
    FRONT = "front"
    """In front of a plate that is flush with a rigid surface around it."""


# Dry air at 20 °C and 101325 Pa (Lemmon and Jacobsen, Int. J. Thermophys. 25 (2004) 21): density
# [kg/m³], viscosity [Pa s], thermal conductivity [W/(m K)], heat capacity [J/(kg K)], its ratio.
PRESSURE = 101_325.0
AIR_DENSITY, VISCOSITY, CONDUCTIVITY = 1.204, 18.2e-6, 25.9e-3
HEAT_CAPACITY, HEAT_RATIO = 1006.0, 1.402

# Depth [thicknesses of the boundary layer] down to which friction hardly couples modes, and down to
# which the coupling changes the response by some 10 %: measured on responses of the paper's plate
# and of a panel over 10 um to 10 mm, solved in modes and at each frequency.
_OPEN, _SEALED = (5.0, 1.4), (1.0, 0.28)


@dataclass(frozen=True)
class AirGap:
    """An air gap between the whole plate and a rigid wall."""

    depth: float  # m
    closed: bool = False
    """Whether the gap is sealed along all edges; otherwise it is open along all edges."""

    def __post_init__(self) -> None:
        """Reject a depth that is not above zero."""
        expect_values(self, "air gap", above="depth")

    def coupling_error(self, frequency: float) -> float:
        """Estimated relative error of the response without the coupling of modes by friction.

        It depends on the depth at a frequency [Hz] in thicknesses sqrt(2 mu / (rho omega)) of the
        boundary layer. 0 for a deep gap, whose error is within 3 % (sealed: 5 %); then 0.1; 0.5 for
        a gap too narrow for modes, whose error is half of the response and more.
        """
        relative_depth = self.depth / math.sqrt(VISCOSITY / (math.pi * AIR_DENSITY * frequency))
        deep, modal = _SEALED if self.closed else _OPEN
        if relative_depth >= deep:
            return 0.0
        return 0.1 if relative_depth >= modal else 0.5

    def inertia(self, frequency: float) -> complex:
        """rho b [kg/m³] at a frequency [Hz]: density of air that friction holds back."""
        wall = self._wall_share(frequency, AIR_DENSITY / VISCOSITY)
        return AIR_DENSITY / (1 - wall)

    def bulk_modulus(self, frequency: float) -> complex:
        """B [Pa] at a frequency [Hz]: isothermal in the slow limit, adiabatic in the fast."""
        wall = self._wall_share(frequency, AIR_DENSITY * HEAT_CAPACITY / CONDUCTIVITY)
        return HEAT_RATIO * PRESSURE / (1 + (HEAT_RATIO - 1) * wall)

    def _wall_share(self, frequency: float, per_frequency: float) -> complex:
        """tanh(s) / s, the share of the depth that walls govern."""
        s = self.depth / 2 * cmath.sqrt(2j * math.pi * frequency * per_frequency)
        return (1.0 if s.real > 300 else cmath.tanh(s)) / s


MAX_LOSS_FACTOR, MAX_LOSS_EXPONENT = 1.0, 2.0

SHEAR_CORRECTION = 5 / 6

LOSS_FREQUENCY = 150.0
"""Frequency at which a varying loss factor has its stated value [Hz]."""


def _scales(*, is_of_theory: bool = True, has_own_row: bool = False) -> dict[str, bool]:
    """Metadata of a field of `Plate` whose mass and stiffness scale with the plate's.

    The plate's mass scales with its thickness h, its bending stiffness with E h³. If all parts
    scale like this, or are a fraction of the plate, one solution serves for other thicknesses and
    moduli. A field without this metadata does not scale (`check_scales`), so a plate that has it
    must be solved for each thickness.

    is_of_theory: whether the theoretical modes of the plate depend on the field. If not, a table is
    updated when the field changes, and identified modes remain valid.
    has_own_row: whether a summary shows the field in a separate row, not among the quantities.
    """
    return {"scales": True, "is_of_theory": is_of_theory, "has_own_row": has_own_row}


@dataclass(frozen=True)
class Plate(Sheet):
    """A rectangular plate of constant thickness with its corner at the origin."""

    length: float = field(metadata=_scales(has_own_row=True))
    """Along x [m]."""

    width: float = field(metadata=_scales(has_own_row=True))
    """Along y [m]."""

    thickness: float = field(metadata=_scales())
    """Thickness [m]; for a laminate, of the equivalent homogeneous plate."""

    material: Material = field(metadata=_scales())
    """Material; for a laminate, of the equivalent homogeneous plate."""

    loss_factor: float = field(default=0.01, metadata=_scales(is_of_theory=False))
    """Structural loss factor eta of a hysteretic stiffness (1 + i eta) K, at LOSS_FREQUENCY.

    The paper does not print it; 1 % is the usual order for a metal or glass panel with its bonded
    layers.
    """

    loss_exponent: float = field(default=0.0, metadata=_scales(is_of_theory=False))
    """The loss factor varies as this power of the frequency."""

    mode_deviations: tuple[tuple[float, float], ...] = field(
        default=(), metadata=_scales(is_of_theory=False)
    )
    """Logarithms of eigenvalue and loss factor of the lowest elastic modes, relative to the theory,
    in ascending order; found by `era rig identify` (see `model.structure.modal_elasticity`).
    """

    laminate: Laminate | None = field(default=None, metadata=_scales())
    """Layers that are solved as they are; None for a homogeneous plate.

    Scaled like the homogeneous plate, which is up to a fifth too much for a soft adhesive.
    """

    air: SurroundingAir | None = field(default=None, metadata=_scales())
    """Open air that moves with the plate; None for a vacuum.

    Scaled with the plate's mass; it changes by 0.1 % of this mass over 2 % of thickness.
    """

    air_gap: AirGap | None = field(default=None, metadata=_scales())
    """Air between the plate and a rigid wall; None without a wall.

    Scaled like the homogeneous plate, which is a fifth too much for air of 0.5 mm or more.
    """

    surface: Surface | None = field(default=None, metadata=_scales())
    """Modes of another program that take the place of its own; the plate is like them.

    Natural frequencies and modal masses scale with the thickness.
    """

    def __post_init__(self) -> None:
        """Reject values out of range."""
        expect_values(self, "plate", above="length width thickness")
        expect_between(self.loss_factor, 0, MAX_LOSS_FACTOR, what="plate: loss_factor")
        expect_between(
            self.loss_exponent, -MAX_LOSS_EXPONENT, MAX_LOSS_EXPONENT, what="plate: loss_exponent"
        )
        # A file gives lists; only tuples can be compared and hashed with the rest.
        deviations = tuple((float(a), float(b)) for a, b in self.mode_deviations)
        object.__setattr__(self, "mode_deviations", deviations)

    @property
    def needs_polynomials(self) -> bool:
        """Whether layers or air are solved with it, in polynomials only."""
        return self.laminate is not None or self.air_gap is not None or self.air is not None

    def scaled(self, *, modulus: float = 1.0, thickness: float = 1.0) -> "Plate":
        """Return the plate with moduli and thickness (also of all layers) multiplied by factors."""
        laminate = self.laminate
        return replace(
            self,
            material=replace(self.material, E=modulus * self.material.E),
            thickness=thickness * self.thickness,
            laminate=laminate and laminate.scaled(modulus=modulus, thickness=thickness),
        )

    @property
    def mass(self) -> float:
        """Mass of the bare plate [kg]."""
        return self.surface_density * self.length * self.width

    @property
    def shear_rigidity(self) -> float:
        """Shear rigidity kappa G h [N/m], paper Eq. 7; of a board the mean of its directions.

        Of the compliance: 1 / (S1 c² + S2 s²) has the mean 1 / sqrt(S1 S2).
        """
        G = self.material.E * math.sqrt(self.material.shares.g13 * self.material.shares.g23)
        return SHEAR_CORRECTION * G * self.thickness

    @property
    def lowest_bending_frequency(self) -> float:
        """Lowest frequency [Hz] of a strip of the plate's longer side on two simple supports.

        The order of magnitude of the plate's lowest modes for any support.
        """
        return self.bending_frequency(2 * max(self.length, self.width))

    def bending_wavelength(self, frequency: float) -> float:
        """Wavelength [m] of a bending wave at a frequency [Hz] in the thin-plate limit.

        Of a board the shortest of all directions.
        """
        omega = 2 * math.pi * frequency
        wavenumber = (self.surface_density * omega**2 / self.least_rigidity) ** 0.25
        return float(2 * math.pi / wavenumber)

    def bending_frequency(self, wavelength: float) -> float:
        """Frequency [Hz] of a bending wave of a wavelength [m] in the thin-plate limit."""
        return 2 * math.pi * math.sqrt(self.least_rigidity / self.surface_density) / wavelength**2

    def wave_stiffness(self, frequency: float) -> float:
        """Dynamic stiffness of an infinite plate under a point force, |F / w| [N/m]."""
        omega = 2 * math.pi * frequency
        return 8 * omega * math.sqrt(self.flexural_rigidity * self.surface_density)

    def modes_below(self, frequency: float) -> int:
        """Number of modes of the free plate up to a frequency [Hz], as an estimate.

        Area term of the mode count of a thin plate, pi S / wavelength², and a quarter more for its
        edges.
        """
        stretch = math.sqrt(self.least_rigidity / self.flexural_rigidity)
        area = self.length * self.width * stretch / self.bending_wavelength(frequency) ** 2
        return math.ceil(EDGES * math.pi * area)

    def contains(self, x: float, y: float) -> bool:
        """Return whether a point [m] is on the plate, edges included."""
        is_near = 0 <= x <= self.length and 0 <= y <= self.width
        if not is_near or self.surface is None:
            return is_near
        return bool(self.covers(np.array([[x, y]]))[0])

    def covers(self, points: FloatArray) -> NDArray[np.bool_]:
        """Whether points (p, 2) [m] of its rectangle are within the outline of a surface, (p,)."""
        if self.surface is None or not self.surface.outline:
            return np.ones(len(points), dtype=bool)
        return is_within(self.surface.outline, points)


FIELDS_BESIDE_THEORY = tuple(
    plate_field.name
    for plate_field in fields(Plate)
    if not plate_field.metadata.get("is_of_theory", True)
)
"""Fields of a plate that leave the modes of its theory as they are."""
