"""Touch plate: its layers, the air behind it, its bending stiffness, and its equivalent plate.

In this order: sheet, laminate, air gap, plate; then the stiffness of a laminate's section, its
bending waves, and its equivalent homogeneous plate.

Every layer of a laminate (such as cover glass on adhesive on a panel) bends, stretches and shears
individually. Displacements along the plate are continuous from layer to layer and linear within
each (a layerwise theory of first order: Reddy, Mechanics of Laminated Composite Plates and Shells,
2nd ed., ch. 12); the deflection is the same through the thickness. Soft adhesives between stiff
layers then shear as Kerwin (J. Acoust. Soc. Am. 31 (1959) 952) and Mead and Markus (J. Sound Vib.
10 (1969) 163) predict: more, the shorter the wave. With stiff adhesives it becomes classical
laminate theory. Loose layers (`Bond.NONE`) slide on each other without friction. Bonded layers are
solved individually (`model.spectral.modes`); loose layers and single layers as the homogeneous
plate, which also gives wavelengths, meshes and estimates.

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

Not modeled: a change of thickness of layers, for example of foam under a force at a point; change
of an adhesive with temperature; air between loose layers.
"""

import cmath
import math
from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from model.arrays import ComplexArray, FloatArray
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


# Dry air at 20 °C and 101325 Pa (Lemmon and Jacobsen, Int. J. Thermophys. 25 (2004) 21): density
# [kg/m³], viscosity [Pa s], thermal conductivity [W/(m K)], heat capacity [J/(kg K)], its ratio.
PRESSURE = 101_325.0
_DENSITY, VISCOSITY, CONDUCTIVITY = 1.204, 18.2e-6, 25.9e-3
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
        relative_depth = self.depth / math.sqrt(VISCOSITY / (math.pi * _DENSITY * frequency))
        deep, modal = _SEALED if self.closed else _OPEN
        if relative_depth >= deep:
            return 0.0
        return 0.1 if relative_depth >= modal else 0.5

    def inertia(self, frequency: float) -> complex:
        """rho b [kg/m³] at a frequency [Hz]: density of air that friction holds back."""
        wall = self._wall_share(frequency, _DENSITY / VISCOSITY)
        return _DENSITY / (1 - wall)

    def bulk_modulus(self, frequency: float) -> complex:
        """B [Pa] at a frequency [Hz]: isothermal in the slow limit, adiabatic in the fast."""
        wall = self._wall_share(frequency, _DENSITY * HEAT_CAPACITY / CONDUCTIVITY)
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

    air_gap: AirGap | None = field(default=None, metadata=_scales())
    """Air between the plate and a rigid wall; None for a plate in the open.

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
    def is_layered(self) -> bool:
        """Whether it is solved by layers and with the air behind it, in polynomials only."""
        return self.laminate is not None or self.air_gap is not None

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
        return is_near and bool(self.covers(np.array([[x, y]]))[0])

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

_MAX_STEPS = 200  # of the iteration for a wavenumber, which takes some twenty
_EXACT, _CONVERGED = 1e-12, 1e-6  # relative changes in a step: that end it, that are sufficient


# 6 / h times the integrals of products of two linear functions over the thickness h of a layer.
_LINEAR = np.array([[2.0, 1.0], [1.0, 2.0]])


@dataclass(frozen=True)
class Bending:
    """Bending properties of a thin plate."""

    rigidity: float  # D [N m]
    nu: float
    bonded: float = 1.0
    """1 for layers without slip, 0 for layers that slide without friction."""


@dataclass(frozen=True, eq=False)
class CrossSection:
    """Stiffness per area of n layers in the displacements u along the plate at n + 1 interfaces.

    across, twist (n + 1, n + 1) [N/m]: of u_x,x u_y,y and of (u_x,y + u_y,x)². Along x and then
    along y: stretch (2, n + 1, n + 1) [N/m]: of u_x,x u_x,x; slip (2, n + 1, n + 1) [N/m³]: of u u;
    lever (2, n + 1) [N/m²] and shear (2,) [N/m]: of u w,x and of (w,x)². Linear in the moduli,
    complex with losses.
    """

    stretch: ComplexArray
    across: ComplexArray
    twist: ComplexArray
    slip: ComplexArray
    lever: ComplexArray
    shear: ComplexArray

    def in_motions(self, motions: FloatArray) -> "CrossSection":
        """The section in k motions of the interfaces, each a column (n + 1, k)."""
        return CrossSection(
            stretch=motions.T @ self.stretch @ motions,
            across=motions.T @ self.across @ motions,
            twist=motions.T @ self.twist @ motions,
            slip=motions.T @ self.slip @ motions,
            lever=self.lever @ motions,
            shear=self.shear,
        )


def opposite_motions(layers: Sequence[LaminateLayer]) -> FloatArray:
    """Motions of the interfaces that bending can excite, orthonormal columns (n + 1, k).

    In a symmetric laminate, interfaces move opposite to their mirror images: half of the motions,
    or the rotation of a single layer.
    """
    count = len(layers) + 1
    if tuple(layers) != tuple(layers)[::-1]:
        return np.eye(count)
    half = np.eye(count)[:, : count // 2]
    return (half - half[::-1]) / math.sqrt(2)


def section_of(
    layers: Sequence[LaminateLayer], moduli: Sequence[complex], corrections: FloatArray
) -> CrossSection:
    """Section of layers with these Young's moduli [Pa]; corrections: of `shear_corrections`."""
    size = len(layers) + 1
    across, twist = np.zeros((2, size, size), dtype=complex)
    stretch, slip = np.zeros((2, 2, size, size), dtype=complex)
    lever = np.zeros((2, size), dtype=complex)
    shear = np.zeros(2, dtype=complex)
    ends = np.array([-1.0, 1.0])
    for number, (layer, modulus, kappa) in enumerate(zip(layers, moduli, corrections, strict=True)):
        h = layer.thickness
        shares = layer.material.shares
        own = slice(number, number + 2)  # the interfaces of the layer
        linear = h / 6 * _LINEAR
        plane = modulus / layer.material.plane_stress
        across[own, own] += layer.material.nu * shares.e2 * plane * linear
        twist[own, own] += shares.g12 * modulus * linear
        for side, (E, G) in enumerate([(1.0, shares.g13), (shares.e2, shares.g23)]):
            stretch[side, own, own] += E * plane * linear
            slip[side, own, own] += kappa * G * modulus / h * np.outer(ends, ends)
            lever[side, own] += kappa * G * modulus * ends
            shear[side] += kappa * G * modulus * h
    return CrossSection(stretch, across, twist, slip, lever, shear)


def interface_mass(layers: Sequence[LaminateLayer]) -> FloatArray:
    """Mass per area [kg/m²] of displacements along the plate at the interfaces, (n + 1, n + 1)."""
    mass = np.zeros((len(layers) + 1, len(layers) + 1))
    for number, layer in enumerate(layers):
        own = slice(number, number + 2)
        mass[own, own] += layer.surface_density / 6 * _LINEAR
    return mass


def slide_frequency(laminate: Laminate, frequency: float) -> float:
    """Lowest natural frequency [Hz] of bonded layers that slide on each other without bending.

    With the moduli at a frequency [Hz]. For two faces of mass m'' per area on a light core of G and
    h it is sqrt(2 G / (h m'')) / (2 pi). The distance of the faces vibrates in the same way, with
    the modulus of compression in place of G.
    """
    layers = laminate.layers
    moduli = [layer.modulus(frequency).real for layer in layers]
    slip = section_of(layers, moduli, shear_corrections(layers)).slip[0].real
    squares = np.linalg.eigvals(np.linalg.solve(interface_mass(layers), slip)).real
    return math.sqrt(np.sort(squares)[1]) / (2 * math.pi)


def shear_corrections(layers: Sequence[LaminateLayer]) -> FloatArray:
    """Shear correction factor of each layer (n,): 5/6 for a single layer, 1 for a soft core.

    (∫ tau)² / (h ∫ tau²) over the layer, with tau the shear stress that balances the bending stress
    of layers without slip. Exact in soft layers between stiff ones, where shear matters most.
    """
    factors = np.empty(len(layers))
    E, nu, thickness, centers = _columns(layers)
    plane = E / (1 - nu**2)
    neutral = plane * thickness @ centers / (plane @ thickness)
    bottoms = centers - thickness / 2 - neutral
    stress = 0.0  # tau at the bottom of the layer; tau' = -E (z - neutral)
    t, weights = np.polynomial.legendre.leggauss(4)
    for number, (E, h, bottom) in enumerate(zip(plane, thickness, bottoms, strict=True)):
        z = bottom + h * (1 + t) / 2
        tau = stress - E * (z**2 - bottom**2) / 2
        factors[number] = (weights @ tau) ** 2 / (2 * (weights @ tau**2))
        top = bottom + h
        stress -= E * (top**2 - bottom**2) / 2
    return factors


def perfectly_bonded(layers: Sequence[LaminateLayer]) -> Bending:
    """Layers without slip: D* = D - B A⁻¹ B of classical laminate theory.

    Jones, Mechanics of Composite Materials, 2nd ed., ch. 4; the reduction is Ashton's, J. Compos.
    Mater. 3 (1969) 189. For isotropic layers A, B and D have the same eigenvectors: equal bending
    in both directions, with the modulus E / (1 - nu), and opposite bending, with E / (1 + nu).
    """
    E, nu, h, z = _columns(layers)

    def reduced(moduli: FloatArray) -> float:
        A, B, D = np.array([np.ones(len(z)), z, h**2 / 12 + z**2]) @ (moduli * h)
        return float(D - B**2 / A)

    equal = reduced(E / (1 - nu))
    opposite = reduced(E / (1 + nu))
    return Bending((equal + opposite) / 2, (equal - opposite) / (equal + opposite))


def freely_sliding(layers: Sequence[LaminateLayer]) -> Bending:
    """Layers that share only their deflection: the sum of their rigidities."""
    rigidity = sum(layer.flexural_rigidity for layer in layers)
    coupling = sum(layer.material.nu * layer.flexural_rigidity for layer in layers)
    return Bending(rigidity, coupling / rigidity, bonded=0.0)


def wave_rigidity(laminate: Laminate, wavenumber: complex, frequency: float) -> complex:
    """D(k) [N m] of a straight wave of w = cos(k x), k [1/m], with the moduli at a frequency [Hz].

    The displacements at the interfaces take the least energy: k⁴ D = k² shear - k² lever (k²
    stretch + slip)⁻¹ lever.
    """
    layers = laminate.layers
    k2 = wavenumber**2
    if laminate.bond is Bond.NONE:
        return freely_sliding(layers).rigidity + 0j
    moduli = [layer.modulus(frequency) for layer in layers]
    section = section_of(layers, moduli, shear_corrections(layers))
    lever = section.lever[0]
    displacements = np.linalg.solve(k2 * section.stretch[0] + section.slip[0], lever)
    return complex((section.shear[0] - lever @ displacements) / k2)


def wavenumber_of(laminate: Laminate, frequency: float) -> complex:
    """k [1/m] of the free bending wave of a frequency [Hz], D(k) k⁴ = m'' omega².

    Rotary inertia is left out. Complex with losses: a wave exp(-i k x) then decays, k has a
    negative imaginary part. Raises InputError if the iteration does not converge; since D falls at
    most as k^-2, each step at least halves the error.
    """
    inertia = laminate.surface_density * (2 * math.pi * frequency) ** 2
    k = complex((inertia / freely_sliding(laminate.layers).rigidity) ** 0.25)
    for _ in range(_MAX_STEPS):
        last_k = k
        k = (inertia / wave_rigidity(laminate, last_k, frequency)) ** 0.25
        change = abs(k - last_k) / abs(last_k)
        if change < _EXACT:
            break
    if not change < _CONVERGED:  # also NaN
        raise InputError(
            f"laminate: its wave at {frequency:g} Hz must converge in {_MAX_STEPS} steps, got a "
            f"relative change of {change:.2g} in the last one; check the moduli of its layers"
        )
    return k


def _columns(
    layers: Sequence[LaminateLayer],
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Moduli [Pa], Poisson's ratios, thicknesses, and heights of the middles above the face [m]."""
    rows = [(layer.material.E, layer.material.nu, layer.thickness) for layer in layers]
    moduli, nu, thickness = np.array(rows).T
    return moduli, nu, thickness, np.cumsum(thickness) - thickness / 2


def bending(laminate: Laminate, frequency: float) -> Bending:
    """Rigidity and Poisson's ratio of the free bending wave of a frequency [Hz].

    The ratio is between the values for perfectly bonded and freely sliding layers.
    """
    return _bending_at(laminate, abs(wavenumber_of(laminate, frequency)), frequency)


def equivalent_plate(
    laminate: Laminate, *, length: float, width: float, frequency: float, loss_factor: float = 0.01
) -> Plate:
    """Make the plate of a laminate, with its homogeneous equivalent at a frequency [Hz].

    length, width [m]. It keeps the laminate if its layers are solved individually, i.e. unless they
    slide or there is a single elastic layer.
    """
    first = laminate.layers[0]
    if len(laminate.layers) == 1 and first.is_elastic:
        return Plate(length, width, first.thickness, first.material, loss_factor)
    plate = _homogeneous(laminate, bending(laminate, frequency), length, width, loss_factor)
    if laminate.bond is Bond.NONE:
        return plate
    return Plate(length, width, plate.thickness, plate.material, loss_factor, laminate=laminate)


def short_wave_plate(plate: Plate, wavenumber: float, frequency: float) -> Plate:
    """The homogeneous plate with the rigidity of a plate in waves of a wavenumber [1/m]."""
    laminate = plate.laminate
    if laminate is None:
        return plate
    bent = _bending_at(laminate, wavenumber, frequency)
    return _homogeneous(laminate, bent, plate.length, plate.width, plate.loss_factor)


def _bending_at(laminate: Laminate, wavenumber: float, frequency: float) -> Bending:
    bonded = perfectly_bonded(laminate.layers)
    sliding = freely_sliding(laminate.layers)
    rigidity = wave_rigidity(laminate, wavenumber, frequency).real
    gain = bonded.rigidity - sliding.rigidity
    share = (rigidity - sliding.rigidity) / gain if gain > 1e-9 * rigidity else 0.0
    share = min(max(share, 0.0), 1.0)
    coupling = share * bonded.nu * bonded.rigidity + (1 - share) * sliding.nu * sliding.rigidity
    return Bending(rigidity, coupling / (share * gain + sliding.rigidity), share)


def _homogeneous(
    laminate: Laminate, bent: Bending, length: float, width: float, loss_factor: float
) -> Plate:
    """The plate of a rigidity with the laminate's mass and rotary inertia."""
    density = laminate.surface_density
    # Each layer rotates about its own middle, and moves along the plate as far as it is bonded.
    E, nu, h, z = _columns(laminate.layers)
    stiffness = E * h / (1 - nu**2)
    off_neutral = bent.bonded * (z - stiffness @ z / stiffness.sum())
    densities = np.array([layer.surface_density for layer in laminate.layers])
    rotary_inertia = float(densities @ (h**2 / 12 + off_neutral**2))
    thickness = math.sqrt(12 * rotary_inertia / density)
    return Plate(
        length=length,
        width=width,
        thickness=_rounded(thickness),
        material=Material(
            laminate.layers[0].material.name if len(laminate.layers) == 1 else "laminate",
            E=_rounded(12 * bent.rigidity * (1 - bent.nu**2) / thickness**3),
            rho=_rounded(density / thickness),
            nu=_rounded(bent.nu),
        ),
        loss_factor=loss_factor,
    )


def _rounded(value: float) -> float:
    """Round to twelve digits, so that the same plate has the same fingerprint."""
    return float(f"{value:.12g}")
