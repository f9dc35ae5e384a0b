"""How a plate's stiffness between given shapes changes with its sides and its Poisson's ratios.

Displacements along the plate follow deflections by least energy: a change of stiffness dK then
changes the energy of shapes v by v^T dK v, to first order without a solve of another plate. All
changes are exact:

- A side times 1 / s, with functions that are stretched with it and displacements along it times s,
  as slopes are: K is a polynomial of second degree in s², whose central difference is its slope.
- K (1 - nu²) is linear in Poisson's ratio nu of a layer, which all layers have changed alike.

What the air behind a plate adds is left out, and how rotary inertia changes.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from model.arrays import FloatArray
from model.fem.plate import NUS, SQUARES
from model.spectral.functions import CLASSES, EdgedFunctions, edge_decays
from model.spectral.modes import layers_of
from model.spectral.stiffness import ClassFunctions, class_stiffness, follow
from model.structure.laminate_section import (
    Section,
    interface_mass,
    section_of,
    shear_corrections,
)
from model.structure.plate import Layer, Plate


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

    def section(moduli: FloatArray, nu: float | None = None) -> Section:
        changed = layers if nu is None else [_with_nu(each, nu) for each in layers]
        return section_of(changed, moduli.tolist(), corrections)

    nominal = section(moduli)
    decays = edge_decays(nominal)
    sides = plate.length, plate.width
    x, y = (
        {
            square: EdgedFunctions(
                side / square**0.5, degree, tuple(k * square**0.5 for k in decays)
            )
            for square in (1.0, *SQUARES)
        }
        for side, degree in zip(sides, degrees, strict=True)
    )
    slopes = np.zeros((3, *2 * unknowns[0].shape[1:]))
    scale = 1 - nus**2
    shift = (2 * np.pi * plate.lowest_bending_frequency) ** 2
    for parity, w in zip(CLASSES, unknowns, strict=True):
        of = ClassFunctions(x[1.0], y[1.0], parity, len(layers) + 1)
        along = follow(of, class_stiffness(of, nominal), interface_mass(layers), shift) @ w
        v = np.vstack([w, along])
        first_y = of.deflections + of.interfaces * of.of_x[0] * of.of_x[1]
        for axis, own in enumerate((slice(of.deflections, first_y), slice(first_y, None))):
            for square, share in zip(SQUARES, (2.0, -2.0), strict=True):  # d s² / d ln side = -2
                functions = replace(of, x=x[square]) if axis == 0 else replace(of, y=y[square])
                stretched = v.copy()
                stretched[own] *= square**0.5
                K = class_stiffness(functions, nominal)
                slopes[axis] += share * (stretched.T @ K @ stretched)
        low, high = NUS
        for changed, share in (
            (section(moduli * (1 - high**2) / scale, high), 1 / (high - low)),
            (section(moduli * (1 - low**2) / scale, low), -1 / (high - low)),
            (section(moduli * 2 * nus / scale), 1.0),
        ):
            slopes[2] += share * (v.T @ class_stiffness(of, changed) @ v)
    return slopes


def _with_nu(layer: Layer, nu: float) -> Layer:
    return replace(layer, material=replace(layer.material, nu=nu))
