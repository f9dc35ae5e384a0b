"""The homogeneous plate that is like a laminate at one frequency.

It gives wavelengths, meshes and estimates; loose layers and a single one are solved as it. Bonded
layers are solved as they are (`model.spectral.modes`).
"""

import math

import numpy as np

from model.structure.laminate_section import (
    Bending,
    freely_sliding,
    perfectly_bonded,
    wave_rigidity,
    wavenumber_of,
)
from model.structure.plate import Bond, Laminate, Material, Plate


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
    return Bending(rigidity, coupling / (share * gain + sliding.rigidity))


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
            "laminate",
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
    layers = laminate.layers
    bonded, sliding = perfectly_bonded(layers).rigidity, freely_sliding(layers).rigidity
    gain = bonded - sliding
    share = (bent.rigidity - sliding) / gain if gain > 1e-9 * bonded else 0.0
    densities = np.array([layer.surface_density for layer in layers])
    thickness = np.array([layer.thickness for layer in layers])
    stiffness = np.array(
        [layer.material.E * layer.thickness / (1 - layer.material.nu**2) for layer in layers]
    )
    centres = np.cumsum(thickness) - thickness / 2
    off_neutral = min(max(share, 0.0), 1.0) * (centres - stiffness @ centres / stiffness.sum())
    return float(densities @ (thickness**2 / 12 + off_neutral**2))


def _rounded(value: float) -> float:
    """Round to twelve digits, so that the same plate has the same fingerprint."""
    return float(f"{value:.12g}")
