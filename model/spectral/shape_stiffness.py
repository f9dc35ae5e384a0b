"""How a plate's stiffness between given shapes changes with its sides and its Poisson's ratios.

Displacements along the plate follow deflections by least energy: a change of stiffness dK then
changes the energy of shapes v by v^T dK v, to first order without a solve of another plate. By a
side it has a closed form (`class_stiffness`); by Poisson's ratio nu of a layer, which all layers
have changed alike, by what a small change of it does to the section, in which K is linear.

What the air behind a plate adds is left out, and how rotary inertia changes.
"""

from collections.abc import Iterator, Sequence
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

_STEP = 1e-4  # of Poisson's ratio: exact to its square


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
    moduli = [layer.modulus(frequency).real for layer in layers]

    def section(further_nu: float) -> CrossSection:
        changed = [_with_nu(each, further_nu) for each in layers]
        return section_of(changed, moduli, corrections)

    nominal = section(0.0)
    slopes = np.zeros((3, *2 * unknowns[0].shape[1:]))
    for of, v in _shapes(plate, degrees, unknowns, nominal):
        for side in range(2):
            slopes[side] += v.T @ class_stiffness(of, nominal, side) @ v
        for step in (_STEP, -_STEP):
            slopes[2] += v.T @ class_stiffness(of, section(step)) @ v / (2 * step)
    return slopes


def grain_slopes(
    plate: Plate, degrees: tuple[int, int], unknowns: Sequence[FloatArray]
) -> FloatArray:
    """Derivatives of the stiffness of shapes (r,) of a board, (2, r), each by itself.

    By the logarithms of its modulus across the length and of its shear modulus in the plane.
    unknowns: as of `stiffness_slopes`.
    """
    layers = layers_of(plate)
    material, thickness = plate.material, plate.thickness

    def section(**shares: float) -> CrossSection:
        other = replace(material, orthotropy=replace(material.shares, **shares))
        layer = LaminateLayer(other, thickness)
        return section_of([layer], [material.E], shear_corrections(layers))

    slopes = np.zeros((2, unknowns[0].shape[1]))
    for of, v in _shapes(plate, degrees, unknowns, section()):
        for number, key in enumerate(("e2", "g12")):
            own = getattr(material.shares, key)
            for step in (_STEP, -_STEP):
                K = class_stiffness(of, section(**{key: own * (1 + step)}))
                slopes[number] += np.einsum("nr,nr->r", v, K @ v) / (2 * step)
    return slopes


def _shapes(
    plate: Plate, degrees: tuple[int, int], unknowns: Sequence[FloatArray], nominal: CrossSection
) -> Iterator[tuple[ClassFunctions, FloatArray]]:
    """Yield of each class its functions, and shapes with their displacements along the plate."""
    layers = layers_of(plate)
    x, y = (
        EdgedFunctions(side, degree, edge_decays(nominal, along))
        for along, (side, degree) in enumerate(
            zip((plate.length, plate.width), degrees, strict=True)
        )
    )
    shift = (2 * np.pi * plate.lowest_bending_frequency) ** 2
    for parity, w in zip(CLASSES, unknowns, strict=True):
        of = ClassFunctions(x, y, parity, len(layers) + 1)
        along = follow(of, class_stiffness(of, nominal), interface_mass(layers), shift) @ w
        yield of, np.vstack([w, along])


def _with_nu(layer: LaminateLayer, further: float) -> LaminateLayer:
    return replace(layer, material=replace(layer.material, nu=layer.material.nu + further))
