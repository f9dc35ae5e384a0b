"""A laminate, such as cover glass on adhesive on a panel, and its equivalent homogeneous plate.

Its rigidity depends on how its layers are joined:

- `full`: no slip. Classical laminate theory, stiffness integrals A, B, D over the thickness and
  D* = D - B A⁻¹ B (Jones, Mechanics of Composite Materials, 2nd ed., ch. 4; the reduction is
  Ashton's, J. Compos. Mater. 3 (1969) 189). Exact where all layers have the same Poisson's ratio.
  An upper bound: a soft adhesive shears, so optically clear adhesives make a laminate softer.
- `none`: layers slide on each other, their own rigidities add up. The lower bound.
- `shear`: stiff layers joined by adhesives that shear (Ross, Ungar and Kerwin, in Structural
  Damping, ASME 1959, p. 49; Kerwin, J. Acoust. Soc. Am. 31 (1959) 952). The shorter the wave, the
  more the adhesive shears, so it is valid at one frequency: the rigidity is that for a straight
  bending wave of that frequency, which solves D(k) k⁴ = m'' omega².

Not modelled: edges (free ends let the layers slide more within a few centimetres), the adhesive's
own damping (give it as the plate's loss factor), change of the adhesive with temperature, waves not
much longer than the laminate is thick.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from model.arrays import FloatArray
from model.errors import InputError
from model.structure.plate import Material, Plate


class Bond(StrEnum):
    """How the layers of a laminate hold together."""

    FULL = "full"
    NONE = "none"
    SHEAR = "shear"


@dataclass(frozen=True)
class Layer:
    """One layer of a laminate; thickness [m]."""

    material: Material
    thickness: float

    def __post_init__(self) -> None:
        """Refuse a thickness that is not above zero."""
        if not (math.isfinite(self.thickness) and self.thickness > 0):
            raise InputError(f"layer: thickness must be above zero, got {self.thickness} m")

    @property
    def surface_density(self) -> float:
        """Mass per area [kg/m²]."""
        return self.material.rho * self.thickness

    @property
    def extensional_stiffness(self) -> float:
        """E h / (1 - nu²) [N/m]: of a wide strip pulled lengthwise."""
        return self.material.E * self.thickness / (1 - self.material.nu**2)

    @property
    def flexural_rigidity(self) -> float:
        """Flexural rigidity of the layer alone [N m]."""
        return self.extensional_stiffness * self.thickness**2 / 12


@dataclass(frozen=True)
class Laminate:
    """Layers from one face to the other.

    bond_frequency [Hz]: with `shear` only, where the rigidity is evaluated.
    """

    layers: tuple[Layer, ...]
    bond: Bond = Bond.FULL
    bond_frequency: float | None = None

    def __post_init__(self) -> None:
        """Refuse layers or a bond_frequency that do not fit the bond."""
        if not self.layers:
            raise InputError("laminate: must have at least one layer")
        if self.bond is not Bond.SHEAR:
            if self.bond_frequency is not None:
                raise InputError("laminate: bond_frequency must be left out unless bond is shear")
            return
        if len(self.layers) < 3 or len(self.layers) % 2 == 0:
            raise InputError(
                f"laminate: with bond shear layers must be 3, 5, 7, ..., every second one an "
                f"adhesive, got {len(self.layers)}"
            )
        frequency = self.bond_frequency
        if frequency is None or not (math.isfinite(frequency) and frequency > 0):
            raise InputError(
                f"laminate: with bond shear bond_frequency must be above zero, got {frequency}; "
                "take the middle of the driven range"
            )

    @property
    def thickness(self) -> float:
        """Thickness of all layers together [m]."""
        return sum(layer.thickness for layer in self.layers)

    @property
    def surface_density(self) -> float:
        """Mass per area of all layers [kg/m²]."""
        return sum(layer.surface_density for layer in self.layers)


@dataclass(frozen=True)
class Bending:
    """Bending properties of a thin plate: flexural rigidity D [N m] and Poisson's ratio."""

    rigidity: float
    nu: float


def perfectly_bonded(layers: Sequence[Layer]) -> Bending:
    """Layers without slip: D* = D - B A⁻¹ B of classical laminate theory.

    For isotropic layers A, B and D share their eigenvectors, so the matrices fall apart into equal
    bending both ways, modulus E / (1 - nu), and opposite bending, E / (1 + nu).
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


def bonded_share(laminate: Laminate) -> float:
    """Fraction of the rigidity added by perfect bonding that the bond provides: 1 full, 0 none.

    With shear it follows from the adhesives' shear and the stiff layers' extension in a wave of
    bond_frequency; for three layers it is Kerwin's g / (1 + g), g = G / (h k²) (1/A1 + 1/A3).
    """
    if laminate.bond is Bond.SHEAR and laminate.bond_frequency is not None:
        return _share_in_shear(laminate.layers, laminate.bond_frequency)
    return 0.0 if laminate.bond is Bond.NONE else 1.0


def bending(laminate: Laminate) -> Bending:
    """Rigidity and Poisson's ratio of a laminate by its bond, between the two bounds."""
    share = bonded_share(laminate)
    bonded, sliding = perfectly_bonded(laminate.layers), freely_sliding(laminate.layers)
    rigidity = share * bonded.rigidity + (1 - share) * sliding.rigidity
    coupling = share * bonded.nu * bonded.rigidity + (1 - share) * sliding.nu * sliding.rigidity
    return Bending(rigidity, coupling / rigidity)


def equivalent_plate(
    laminate: Laminate, *, length: float, width: float, loss_factor: float = 0.01
) -> Plate:
    """The homogeneous plate with the laminate's rigidity, Poisson's ratio and surface density.

    length, width [m]. Its thickness gives it the laminate's rotary inertia too: that is the
    laminate's own thickness where its layers are of one material and bonded, one layer's where
    equal layers slide. Its shear stiffness, right in these two cases, is otherwise only what
    follows; for bending waves far longer than the thickness neither matters.
    """
    bent = bending(laminate)
    density = laminate.surface_density
    thickness = math.sqrt(12 * _rotary_inertia(laminate) / density)
    return Plate(
        length=length,
        width=width,
        thickness=_rounded(thickness),
        material=Material(
            "laminate",
            E=_rounded(12 * bent.rigidity * (1 - bent.nu**2) / thickness**3),
            rho=_rounded(density / thickness),
            nu=_rounded(bent.nu),
        ),
        loss_factor=loss_factor,
    )


def _centres(layers: Sequence[Layer]) -> FloatArray:
    """Heights of the layers' middles above the first face [m]."""
    thickness = np.array([layer.thickness for layer in layers])
    return np.asarray(np.cumsum(thickness) - thickness / 2)


def _share_in_shear(layers: Sequence[Layer], frequency: float) -> float:
    """The share for stiff layers and, every second one, adhesives, at a frequency [Hz].

    Under w = sin(k x) the stiff layers' in-plane movements take the least energy of extension and
    adhesive shear together; what they add to the rigidity is arms . (slip + k² shear)⁻¹ . arms.
    """
    from scipy.optimize import brentq  # a fifth of a second that other rigs need not wait for

    stiff, adhesives = layers[0::2], layers[1::2]
    arms = np.diff(_centres(layers)[0::2])
    neighbours = np.diff(np.eye(len(stiff)), axis=0)
    compliance = np.diag([1 / layer.extensional_stiffness for layer in stiff])
    slip = neighbours @ compliance @ neighbours.T
    shear = np.diag([layer.thickness / layer.material.shear_modulus for layer in adhesives])
    rigid = arms @ np.linalg.solve(slip, arms)

    def share(wavenumber: float) -> float:
        return float(arms @ np.linalg.solve(slip + wavenumber**2 * shear, arms) / rigid)

    loose = freely_sliding(layers).rigidity
    gain = perfectly_bonded(layers).rigidity - loose
    inertia = sum(layer.surface_density for layer in layers) * (2 * math.pi * frequency) ** 2

    def excess(wavenumber: float) -> float:
        return (loose + share(wavenumber) * gain) * wavenumber**4 / inertia - 1

    low, high = ((inertia / rigidity) ** 0.25 for rigidity in (loose + gain, loose))
    return share(float(brentq(excess, 0.999 * low, 1.001 * high)))


def _rotary_inertia(laminate: Laminate) -> float:
    """Mass moment per area [kg]: each layer about its own middle, and what moves it lengthwise."""
    densities = np.array([layer.surface_density for layer in laminate.layers])
    thickness = np.array([layer.thickness for layer in laminate.layers])
    stiffness = np.array([layer.extensional_stiffness for layer in laminate.layers])
    centres = _centres(laminate.layers)
    off_neutral = bonded_share(laminate) * (centres - stiffness @ centres / stiffness.sum())
    return float(densities @ (thickness**2 / 12 + off_neutral**2))


def _rounded(value: float) -> float:
    """Round to twelve digits, so that the same plate has the same fingerprint."""
    return float(f"{value:.12g}")
