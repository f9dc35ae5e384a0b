"""Stiffness of a laminate's section, the bounds of its rigidity, and bending waves in it.

The theory of `model.structure.plate`, per area. And the homogeneous plate that is like a laminate
at one frequency: it gives wavelengths, meshes and estimates; loose layers and a single one are
solved as it. Bonded layers are solved as they are (`model.spectral.modes`).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from model.arrays import ComplexArray, FloatArray
from model.structure.plate import Bond, Laminate, LaminateLayer, Material, Plate

_MAX_STEPS = 200  # of the iteration for a wavenumber, which takes some twenty


@dataclass(frozen=True)
class Bending:
    """Bending properties of a thin plate: flexural rigidity D [N m] and Poisson's ratio.

    bonded: how far layers do not slide on each other, 0 to 1.
    """

    rigidity: float
    nu: float
    bonded: float = 1.0


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
        stretch, across, twist, slip = (
            motions.T @ each @ motions
            for each in (self.stretch, self.across, self.twist, self.slip)
        )
        return CrossSection(stretch, across, twist, slip, self.lever @ motions, self.shear)


def opposite_motions(layers: Sequence[LaminateLayer]) -> FloatArray:
    """Motions of the interfaces that bending can excite, orthonormal columns (n + 1, k).

    Where the layers are the same from above as from below, interfaces move opposite to their mirror
    images: half of them, of a single layer its rotation.
    """
    count = len(layers) + 1
    if tuple(layers) != tuple(layers)[::-1]:
        return np.eye(count)
    half = np.eye(count)[:, : count // 2]
    return np.asarray((half - half[::-1]) / math.sqrt(2))


def section_of(
    layers: Sequence[LaminateLayer], moduli: Sequence[complex], corrections: FloatArray
) -> CrossSection:
    """Section of layers with these Young's moduli [Pa]; corrections: of `shear_corrections`."""
    size = len(layers) + 1
    across, twist = (np.zeros((size, size), dtype=complex) for _ in range(2))
    stretch, slip = (np.zeros((2, size, size), dtype=complex) for _ in range(2))
    lever = np.zeros((2, size), dtype=complex)
    shear = np.zeros(2, dtype=complex)
    ends = np.array([-1.0, 1.0])
    for number, (layer, modulus, kappa) in enumerate(zip(layers, moduli, corrections, strict=True)):
        shares, h = layer.material.shares, layer.thickness
        own = slice(number, number + 2)
        linear = h / 6 * np.array([[2.0, 1.0], [1.0, 2.0]])
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
        mass[number : number + 2, number : number + 2] += (
            layer.surface_density / 6 * np.array([[2.0, 1.0], [1.0, 2.0]])
        )
    return mass


def slide_frequency(laminate: Laminate, frequency: float) -> float:
    """Lowest frequency [Hz] at which bonded layers slide to and fro on each other by themselves.

    Everywhere alike, without a deflection, by the moduli at a frequency [Hz]. Of two faces of m''
    on a light core of G and h: sqrt(2 G / (h m'')) / 2 pi; they change their distance in the same
    way, with the modulus of compression in place of G.
    """
    layers = laminate.layers
    moduli = [layer.modulus(frequency).real for layer in layers]
    slip = section_of(layers, moduli, shear_corrections(layers)).slip[0].real
    squares = np.linalg.eigvals(np.linalg.solve(interface_mass(layers), slip)).real
    return math.sqrt(np.sort(squares)[1]) / (2 * math.pi)


def shear_corrections(layers: Sequence[LaminateLayer]) -> FloatArray:
    """Shear correction factor of each layer (n,): 5/6 of a single one, 1 of a soft core.

    (∫ tau)² / (h ∫ tau²) over the layer, tau the shear stress that balances the bending stress of
    layers without slip: exact wherever shear matters, in soft layers between stiff ones.
    """
    factors = np.empty(len(layers))
    E, nu, thickness, centres = _columns(layers)
    plane = E / (1 - nu**2)
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


def perfectly_bonded(layers: Sequence[LaminateLayer]) -> Bending:
    """Layers without slip: D* = D - B A⁻¹ B of classical laminate theory.

    Jones, Mechanics of Composite Materials, 2nd ed., ch. 4; the reduction is Ashton's, J. Compos.
    Mater. 3 (1969) 189. For isotropic layers A, B and D share their eigenvectors, so the matrices
    fall apart into equal bending both ways, modulus E / (1 - nu), and opposite, E / (1 + nu).
    """
    E, nu, h, z = _columns(layers)

    def reduced(moduli: FloatArray) -> float:
        A, B, D = np.array([np.ones(len(z)), z, h**2 / 12 + z**2]) @ (moduli * h)
        return float(D - B**2 / A)

    equal, opposite = reduced(E / (1 - nu)), reduced(E / (1 + nu))
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
    layers, k2 = laminate.layers, wavenumber**2
    if laminate.bond is Bond.NONE:
        return freely_sliding(layers).rigidity + 0j
    moduli = [layer.modulus(frequency) for layer in layers]
    section = section_of(layers, moduli, shear_corrections(layers))
    stretch, slip, lever = section.stretch[0], section.slip[0], section.lever[0]
    moved = np.linalg.solve(k2 * stretch + slip, lever)
    return complex((section.shear[0] - lever @ moved) / k2)


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


def _columns(
    layers: Sequence[LaminateLayer],
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Moduli [Pa], Poisson's ratios, thicknesses, and heights of the middles above the face [m]."""
    rows = [(each.material.E, each.material.nu, each.thickness) for each in layers]
    moduli, nu, thickness = np.array(rows).T
    return moduli, nu, thickness, np.cumsum(thickness) - thickness / 2


def bending(laminate: Laminate, frequency: float) -> Bending:
    """Rigidity and Poisson's ratio of the free bending wave of a frequency [Hz].

    The ratio is between those of perfectly bonded and of freely sliding layers.
    """
    return _bending_at(laminate, abs(wavenumber_of(laminate, frequency)), frequency)


def equivalent_plate(
    laminate: Laminate, *, length: float, width: float, frequency: float, loss_factor: float = 0.01
) -> Plate:
    """The plate of a laminate, with what is alike of a homogeneous one at a frequency [Hz].

    length, width [m]. Its layers are those that are solved, none where they slide or are a single
    elastic one.
    """
    first, *others = laminate.layers
    if not others and first.is_elastic:
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
    bonded, sliding = perfectly_bonded(laminate.layers), freely_sliding(laminate.layers)
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
    thickness = math.sqrt(12 * _rotary_inertia(laminate, bent) / density)
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


def _rotary_inertia(laminate: Laminate, bent: Bending) -> float:
    """Mass moment per area [kg]: each layer about its own middle, and what moves it lengthwise.

    The share of the latter is that of perfect bonding.
    """
    E, nu, h, z = _columns(laminate.layers)
    stiffness = E * h / (1 - nu**2)
    off_neutral = bent.bonded * (z - stiffness @ z / stiffness.sum())
    densities = np.array([layer.surface_density for layer in laminate.layers])
    return float(densities @ (h**2 / 12 + off_neutral**2))


def _rounded(value: float) -> float:
    """Round to twelve digits, so that the same plate has the same fingerprint."""
    return float(f"{value:.12g}")
