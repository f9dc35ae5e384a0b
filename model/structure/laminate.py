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
from bisect import bisect_left
from dataclasses import dataclass, replace
from enum import StrEnum

from model.errors import InputError
from model.structure.material import Material


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
        rows = self.by_frequency
        after = min(max(bisect_left(rows, (frequency,)), 1), len(rows) - 1)
        (f0, factor0, loss0), (f1, factor1, loss1) = rows[after - 1], rows[after]
        share = min(max(math.log(frequency / f0) / math.log(f1 / f0), 0.0), 1.0)
        factor = factor0 * math.pow(factor1 / factor0, share)
        return self.material.E * factor * (1 + 1j * (loss0 + share * (loss1 - loss0)))

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
