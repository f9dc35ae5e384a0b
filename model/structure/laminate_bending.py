"""Bending of a laminate: the stiffness of its section, its waves, and its equivalent plate.

Every layer of a laminate (such as cover glass on adhesive on a panel) bends, stretches and shears
individually. Displacements along the plate are continuous from layer to layer and linear within
each (a layerwise theory of first order: Reddy, Mechanics of Laminated Composite Plates and Shells,
2nd ed., ch. 12); the deflection is the same through the thickness. Soft adhesives between stiff
layers then shear as Kerwin (J. Acoust. Soc. Am. 31 (1959) 952) and Mead and Markus (J. Sound Vib.
10 (1969) 163) predict: more, the shorter the wave. With stiff adhesives it becomes classical
laminate theory. Loose layers (`Bond.NONE`) slide on each other without friction. Bonded layers are
solved individually (`model.spectral.modes`); loose layers and single layers as the homogeneous
plate, which also gives wavelengths, meshes and estimates.

Not modeled: a change of thickness of layers, for example of foam under a force at a point; change
of an adhesive with temperature.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from model.arrays import ComplexArray, FloatArray
from model.errors import InputError
from model.structure.material import Material
from model.structure.plate import Bond, Laminate, LaminateLayer, Plate

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
