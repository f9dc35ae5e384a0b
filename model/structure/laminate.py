"""A laminate, such as cover glass on adhesive on a panel, layer by layer.

Every layer bends, stretches and shears by itself; displacements along the plate are continuous
from layer to layer and linear within each (a layerwise theory of first order: Reddy, Mechanics of
Laminated Composite Plates and Shells, 2nd ed., ch. 12), the deflection is the same through the
thickness. Soft adhesives between stiff layers then shear as in the theories of Kerwin (J. Acoust.
Soc. Am. 31 (1959) 952) and Mead and Markus (J. Sound Vib. 10 (1969) 163), more the shorter the
wave. With stiff adhesives it becomes classical laminate theory.

Layers may also be laid loosely (`Bond.NONE`): they slide on each other without friction.

Not modelled: layers that change their thickness, as a foam does under a force at a point; change of
an adhesive with temperature; air between loose layers.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from model.arrays import ComplexArray, FloatArray
from model.errors import InputError
from model.structure.material import Material

_MAX_STEPS = 200  # of the iteration for a wavenumber, which takes some twenty


class Bond(StrEnum):
    """How the layers of a laminate hold together."""

    FULL = "full"
    NONE = "none"


@dataclass(frozen=True)
class Layer:
    """One layer of a laminate; thickness [m].

    loss_factor: eta of its modulus E (1 + i eta). by_frequency: rows of frequency [Hz], ascending,
    factor of E and loss factor, which then replaces loss_factor; linear in the logarithms of
    frequency and factor, constant outside.
    """

    material: Material
    thickness: float
    loss_factor: float = 0.0
    by_frequency: tuple[tuple[float, float, float], ...] = ()

    def __post_init__(self) -> None:
        """Refuse a thickness that is not above zero."""
        if not (math.isfinite(self.thickness) and self.thickness > 0):
            raise InputError(f"layer: thickness must be above zero, got {self.thickness} m")

    def modulus(self, frequency: float) -> complex:
        """E (1 + i eta) [Pa] at a frequency [Hz]."""
        if not self.by_frequency:
            return self.material.E * (1 + 1j * self.loss_factor)
        rows = np.array(self.by_frequency)
        at = math.log(frequency)
        factor = math.exp(np.interp(at, np.log(rows[:, 0]), np.log(rows[:, 1])))
        loss = float(np.interp(at, np.log(rows[:, 0]), rows[:, 2]))
        return self.material.E * factor * (1 + 1j * loss)

    @property
    def is_elastic(self) -> bool:
        """Whether its modulus is real and the same at all frequencies."""
        return not self.by_frequency and not self.loss_factor

    @property
    def surface_density(self) -> float:
        """Mass per area [kg/m²]."""
        return self.material.rho * self.thickness

    @property
    def flexural_rigidity(self) -> float:
        """Flexural rigidity of the layer alone [N m], of its modulus E."""
        return self.material.E * self.thickness**3 / (12 * (1 - self.material.nu**2))


@dataclass(frozen=True)
class Laminate:
    """Layers from one face to the other."""

    layers: tuple[Layer, ...]
    bond: Bond = Bond.FULL

    def __post_init__(self) -> None:
        """Refuse a laminate without layers, and losses of layers that slide."""
        if not self.layers:
            raise InputError("laminate: must have at least one layer")
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
        layers = (
            replace(
                layer,
                material=replace(layer.material, E=modulus * layer.material.E),
                thickness=thickness * layer.thickness,
            )
            for layer in self.layers
        )
        return replace(self, layers=tuple(layers))


@dataclass(frozen=True)
class Bending:
    """Bending properties of a thin plate: flexural rigidity D [N m] and Poisson's ratio."""

    rigidity: float
    nu: float


@dataclass(frozen=True, eq=False)
class Section:
    """Stiffness per area of n layers in the displacements u along the plate at n + 1 interfaces.

    stretch, across, twist (n + 1, n + 1) [N/m]: of u_x,x u_x,x, of u_x,x u_y,y, and of
    (u_x,y + u_y,x)²; slip (n + 1, n + 1) [N/m³]: of u u; lever (n + 1,) [N/m²] and shear [N/m]: of
    u w,x and of (w,x)². Linear in the moduli, complex with losses.
    """

    stretch: ComplexArray
    across: ComplexArray
    twist: ComplexArray
    slip: ComplexArray
    lever: ComplexArray
    shear: complex


def section_of(
    layers: Sequence[Layer], moduli: Sequence[complex], corrections: FloatArray
) -> Section:
    """Section of layers with these Young's moduli [Pa]; corrections: of `shear_corrections`."""
    size = len(layers) + 1
    stretch, across, twist, slip = (np.zeros((size, size), dtype=complex) for _ in range(4))
    lever = np.zeros(size, dtype=complex)
    shear = 0j
    ends = np.array([-1.0, 1.0])
    for number, (layer, modulus, kappa) in enumerate(zip(layers, moduli, corrections, strict=True)):
        nu, h = layer.material.nu, layer.thickness
        own = slice(number, number + 2)
        linear = h / 6 * np.array([[2.0, 1.0], [1.0, 2.0]])
        plane, G = modulus / (1 - nu**2), modulus / (2 * (1 + nu))
        stretch[own, own] += plane * linear
        across[own, own] += nu * plane * linear
        twist[own, own] += G * linear
        slip[own, own] += kappa * G / h * np.outer(ends, ends)
        lever[own] += kappa * G * ends
        shear += kappa * G * h
    return Section(stretch, across, twist, slip, lever, shear)


def interface_mass(layers: Sequence[Layer]) -> FloatArray:
    """Mass per area [kg/m²] of displacements along the plate at the interfaces, (n + 1, n + 1)."""
    mass = np.zeros((len(layers) + 1, len(layers) + 1))
    for number, layer in enumerate(layers):
        mass[number : number + 2, number : number + 2] += (
            layer.surface_density / 6 * np.array([[2.0, 1.0], [1.0, 2.0]])
        )
    return mass


def shear_corrections(layers: Sequence[Layer]) -> FloatArray:
    """Shear correction factor of each layer (n,): 5/6 of a single one, 1 of a soft core.

    (∫ tau)² / (h ∫ tau²) over the layer, tau the shear stress that balances the bending stress of
    layers without slip: exact wherever shear matters, in soft layers between stiff ones.
    """
    factors = np.empty(len(layers))
    plane = np.array([layer.material.E / (1 - layer.material.nu**2) for layer in layers])
    thickness = np.array([layer.thickness for layer in layers])
    centres = _centres(layers)
    neutral = plane * thickness @ centres / (plane @ thickness)
    bottoms = centres - thickness / 2 - neutral
    stress = 0.0  # tau at the bottom of the layer; tau' = -E (z - neutral)
    t, weights = np.polynomial.legendre.leggauss(4)
    for number, (E, h, bottom) in enumerate(zip(plane, thickness, bottoms, strict=True)):
        z = bottom + h * (1 + t) / 2
        tau = stress - E * (z**2 - bottom**2) / 2
        factors[number] = (weights @ tau) ** 2 / (2 * (weights @ tau**2))
        top = bottom + h
        stress -= E * (top**2 - bottom**2) / 2
    return factors


def perfectly_bonded(layers: Sequence[Layer]) -> Bending:
    """Layers without slip: D* = D - B A⁻¹ B of classical laminate theory.

    Jones, Mechanics of Composite Materials, 2nd ed., ch. 4; the reduction is Ashton's, J. Compos.
    Mater. 3 (1969) 189. For isotropic layers A, B and D share their eigenvectors, so the matrices
    fall apart into equal bending both ways, modulus E / (1 - nu), and opposite, E / (1 + nu).
    """
    centres = _centres(layers)

    def reduced(moduli: Sequence[float]) -> float:
        A = B = D = 0.0
        for layer, z, modulus in zip(layers, centres, moduli, strict=True):
            h = layer.thickness
            A += modulus * h
            B += modulus * h * z
            D += modulus * (h**3 / 12 + h * z**2)
        return float(D - B**2 / A)

    equal = reduced([layer.material.E / (1 - layer.material.nu) for layer in layers])
    opposite = reduced([layer.material.E / (1 + layer.material.nu) for layer in layers])
    return Bending((equal + opposite) / 2, (equal - opposite) / (equal + opposite))


def freely_sliding(layers: Sequence[Layer]) -> Bending:
    """Layers that share only their deflection: the sum of their rigidities."""
    rigidity = sum(layer.flexural_rigidity for layer in layers)
    coupling = sum(layer.material.nu * layer.flexural_rigidity for layer in layers)
    return Bending(rigidity, coupling / rigidity)


def wave_rigidity(laminate: Laminate, wavenumber: complex, frequency: float) -> complex:
    """D(k) [N m] of a straight wave of w = cos(k x), k [1/m], with the moduli at a frequency [Hz].

    The displacements at the interfaces take the least energy: k⁴ D = k² shear - k² lever (k²
    stretch + slip)⁻¹ lever.
    """
    layers, k2 = laminate.layers, wavenumber**2
    if laminate.bond is Bond.NONE:
        return freely_sliding(layers).rigidity + 0j
    moduli = [layer.modulus(frequency) for layer in layers]
    section = section_of(layers, moduli, shear_corrections(layers))
    moved = np.linalg.solve(k2 * section.stretch + section.slip, section.lever)
    return complex((section.shear - section.lever @ moved) / k2)


def wavenumber_of(laminate: Laminate, frequency: float) -> complex:
    """k [1/m] of the free bending wave of a frequency [Hz], D(k) k⁴ = m'' omega².

    Rotary inertia is left out. Complex with losses: a wave exp(-i k x) then decays, k has a
    negative imaginary part.
    """
    inertia = laminate.surface_density * (2 * math.pi * frequency) ** 2
    better = complex((inertia / freely_sliding(laminate.layers).rigidity) ** 0.25)
    for _ in range(_MAX_STEPS):
        k = better
        better = (inertia / wave_rigidity(laminate, k, frequency)) ** 0.25
        if abs(better - k) < 1e-12 * abs(k):
            break
    return better


def _centres(layers: Sequence[Layer]) -> FloatArray:
    """Heights of the layers' middles above the first face [m]."""
    thickness = np.array([layer.thickness for layer in layers])
    return np.asarray(np.cumsum(thickness) - thickness / 2)
