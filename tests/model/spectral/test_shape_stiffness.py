"""Closed derivatives of a plate's stiffness by its sides and Poisson's ratio."""

from dataclasses import replace

import numpy as np
import pytest

from model.fem import ELEMENTS, Mesh, element_slopes
from model.reduction.free_plate import solve_free_plate
from model.spectral.direct_solution import grain_slopes, stiffness_slopes
from model.spectral.modes import SpectralMesh
from model.structure.plate import (
    Laminate,
    LaminateLayer,
    Material,
    Orthotropy,
    Plate,
    equivalent_plate,
)

GLASS = Material("glass", E=70e9, rho=2500.0, nu=0.22)
PLATE = Plate(0.3, 0.21, 0.001, GLASS)
LAYERS = (
    LaminateLayer(GLASS, 0.0004),
    LaminateLayer(Material("glue", E=50e6, rho=1000.0, nu=0.45), 0.0002),
    LaminateLayer(GLASS, 0.0006),
)
SANDWICH = equivalent_plate(Laminate(LAYERS), length=0.3, width=0.21, frequency=200.0)
BIRCH = Material("birch", 12.7e9, 680.0, 0.3, Orthotropy(0.38, 0.055, 0.028, 0.02))
BOARD = Plate(0.3, 0.21, 0.002, BIRCH)
DEGREES = (13, 11)
SPECTRAL = SpectralMesh(*DEGREES, 0.3, 0.21)
ELEMENTARY = Mesh(5, 4, 0.3, 0.21, ELEMENTS["Q5"])
STEP = 2e-3


def elastic_modes(plate, mesh):
    """Eigenvalues (r,) of the lowest elastic modes, ascending, and their unknowns by class."""
    own = replace(mesh, length=plate.length, width=plate.width)
    modes = solve_free_plate(plate, own, frequency_max=800.0).modes
    order = np.argsort(modes.eigenvalues)[3:15]
    unknowns = modes.unknowns(np.array([[0.1, 0.1, 0.0]]))
    return modes.eigenvalues[order], [each[:, order] for each in unknowns]


def slopes_of(plate, mesh):
    """Eigenvalues (r,), and derivatives of the stiffness between their modes (3, r, r)."""
    eigenvalues, unknowns = elastic_modes(plate, mesh)
    if isinstance(mesh, Mesh):
        return eigenvalues, element_slopes(plate, mesh, unknowns[0])
    return eigenvalues, stiffness_slopes(plate, DEGREES, unknowns, frequency=200.0)


def changed(plate, number, change):
    """The plate with another length, width or Poisson's ratio of all that it is made of."""
    if number < 2:
        side = ("length", "width")[number]
        return replace(plate, **{side: getattr(plate, side) * (1 + change)})

    def other(material):
        return replace(material, nu=material.nu + change)

    layers = [replace(layer, material=other(layer.material)) for layer in LAYERS]
    laminate = plate.laminate and Laminate(tuple(layers))
    return replace(plate, material=other(plate.material), laminate=laminate)


@pytest.mark.parametrize(
    ("plate", "mesh"),
    [
        *((PLATE, SPECTRAL), (PLATE, ELEMENTARY), (SANDWICH, SPECTRAL)),
        *((BOARD, SPECTRAL), (BOARD, ELEMENTARY)),
    ],
)
def test_slopes_are_those_of_the_eigenvalues_of_other_plates(plate, mesh):
    """Solved anew a little larger and smaller; rotary inertia accounts for 0.1 %."""
    eigenvalues, slopes = slopes_of(plate, mesh)
    for number, slope in enumerate(slopes):
        more, less = (elastic_modes(changed(plate, number, by), mesh)[0] for by in (STEP, -STEP))
        expected = (more - less) / (2 * STEP)
        np.testing.assert_allclose(
            np.diagonal(slope) / eigenvalues, expected / eigenvalues, atol=2e-3
        )


@pytest.mark.parametrize(("number", "key"), [(0, "e2"), (1, "g12")])
def test_slopes_by_a_grain_are_those_of_boards_of_other_moduli(number, key):
    """Solved anew with a modulus across, or of shear in the plane, a little higher and lower."""
    eigenvalues, unknowns = elastic_modes(BOARD, SPECTRAL)
    slopes = grain_slopes(BOARD, DEGREES, unknowns)[number]

    def board(change):
        shares = replace(BIRCH.orthotropy, **{key: getattr(BIRCH.orthotropy, key) * (1 + change)})
        return replace(BOARD, material=replace(BIRCH, orthotropy=shares))

    more, less = (elastic_modes(board(by), SPECTRAL)[0] for by in (STEP, -STEP))
    expected = (more - less) / (2 * STEP) / eigenvalues
    np.testing.assert_allclose(slopes / eigenvalues, expected, atol=2e-3)


def test_a_thin_plate_scales_with_the_fourth_power_of_its_size():
    """Both sides lower every stiffness alike and couple no modes, up to its edges' share.

    Kirchhoff's theory, without boundary layers as wide as the plate is thick.
    """
    eigenvalues, (length, width, _) = slopes_of(PLATE, SPECTRAL)
    size = np.sqrt(np.outer(eigenvalues, eigenvalues))
    np.testing.assert_allclose(
        (length + width) / size, -4 * np.eye(len(size)), atol=PLATE.thickness / PLATE.width
    )
