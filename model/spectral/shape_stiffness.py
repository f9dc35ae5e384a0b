"""How a plate's stiffness between given shapes changes with its sides and its Poisson's ratios.

Displacements along the plate follow deflections by least energy: a change of stiffness dK then
changes the energy of shapes v by v^T dK v, to first order without a solve of another plate. By a
side it has a closed form (`class_stiffness`); by Poisson's ratio nu of a layer, which all layers
have changed alike, K (1 - nu²) is linear.

What the air behind a plate adds is left out, and how rotary inertia changes.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from model.arrays import FloatArray
from model.spectral.functions import CLASSES, EdgedFunctions, edge_decays
from model.spectral.modes import layers_of
from model.spectral.stiffness import ClassFunctions, class_stiffness, follow
from model.structure.laminate_section import (
    CrossSection,
    interface_mass,
    section_of,
    shear_corrections,
)
from model.structure.plate import LaminateLayer, Plate

_NUS = (0.0, 0.4)  # of a difference: any two


def stiffness_slopes(
    plate: Plate,
    degrees: tuple[int, int],
    unknowns: Sequence[FloatArray],
    *,
    frequency: float,
) -> FloatArray:
    """Derivatives of the stiffness between shapes (r,) of a plate, (3, r, r).

    By the logarithms of length and width, at the same mass, and by Poisson's ratio. unknowns: of
    the shapes in orthonormal polynomials up to these degrees, by symmetry class, (n, r); frequency
    [Hz]: of the moduli.
    """
    layers = layers_of(plate)
    corrections = shear_corrections(layers)
    moduli = np.array([layer.modulus(frequency).real for layer in layers])
    nus = np.array([layer.material.nu for layer in layers])

    def section(moduli: FloatArray, nu: float | None = None) -> CrossSection:
        changed = layers if nu is None else [_with_nu(each, nu) for each in layers]
        return section_of(changed, moduli.tolist(), corrections)

    nominal = section(moduli)
    decays = edge_decays(nominal)
    x, y = (
        EdgedFunctions(side, degree, decays)
        for side, degree in zip((plate.length, plate.width), degrees, strict=True)
    )
    slopes = np.zeros((3, *2 * unknowns[0].shape[1:]))
    scale = 1 - nus**2
    shift = (2 * np.pi * plate.lowest_bending_frequency) ** 2
    for parity, w in zip(CLASSES, unknowns, strict=True):
        of = ClassFunctions(x, y, parity, len(layers) + 1)
        along = follow(of, class_stiffness(of, nominal), interface_mass(layers), shift) @ w
        v = np.vstack([w, along])
        for side in range(2):
            slopes[side] += v.T @ class_stiffness(of, nominal, side) @ v
        low, high = _NUS
        for changed, share in (
            (section(moduli * (1 - high**2) / scale, high), 1 / (high - low)),
            (section(moduli * (1 - low**2) / scale, low), -1 / (high - low)),
            (section(moduli * 2 * nus / scale), 1.0),
        ):
            slopes[2] += share * (v.T @ class_stiffness(of, changed) @ v)
    return slopes


def _with_nu(layer: LaminateLayer, nu: float) -> LaminateLayer:
    return replace(layer, material=replace(layer.material, nu=nu))
