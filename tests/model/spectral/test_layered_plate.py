"""Plates of layers against elasticity, the homogeneous plate, and direct solutions."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import linalg

from benchmarks.direct_plate import direct_responder
from benchmarks.layers.elasticity import strip_frequencies
from model.errors import InputError
from model.fem import Mesh, assemble
from model.reduction.free_plate import solve_free_plate
from model.reduction.reduced_plate import reduce_free_plate, supported_modes
from model.rig.rig_file import load_rig
from model.spectral.direct_solution import AtOneFrequency
from model.spectral.modes import Band, SpectralMesh, SpectralPlate
from model.structure.attachments import Era, footprints_of
from model.structure.plate import Laminate, LaminateLayer, Material, Plate, equivalent_plate
from model.vibration import natural_modes

EXAMPLE = Path(__file__).parents[3] / "examples" / "glass_panel.yaml"
COVER = Material("cover", E=71.5e9, rho=2420.0, nu=0.21)
GLASS = Material("glass", E=70e9, rho=2500.0, nu=0.2)
ADHESIVE = Material("adhesive", E=1e6, rho=1000.0, nu=0.49)
PANEL = (
    LaminateLayer(COVER, 1.8e-3),
    LaminateLayer(ADHESIVE, 0.2e-3),
    LaminateLayer(GLASS, 0.7e-3),
)
THIN = (LaminateLayer(GLASS, 0.7e-3), LaminateLayer(ADHESIVE, 0.1e-3), LaminateLayer(GLASS, 0.7e-3))


def panel(layers, length=0.375, width=0.225, **changes):
    """The plate of some layers."""
    return equivalent_plate(
        Laminate(layers), length=length, width=width, frequency=500.0, **changes
    )


def frequencies_of(plate, degrees, *, parities=((1, 1), (-1, 1), (1, -1), (-1, -1)), cut=1500.0):
    """Natural frequencies [Hz] of elastic modes and their loss factors, ascending."""
    layered = SpectralPlate(plate, degrees, 150.0)
    found = [
        layered.modes(
            each, shift=(2 * np.pi * 30) ** 2, cut=(2 * np.pi * cut) ** 2, band=Band(30.0, cut)
        )
        for each in parities
    ]
    squares = np.concatenate([part.eigenvalues for part in found])
    losses = np.concatenate([part.losses for part in found])
    order = np.argsort(squares)
    order = order[squares[order] > 1]
    return np.sqrt(squares[order]) / (2 * np.pi), losses[order] / squares[order]


def homogeneous_frequencies(plate, mesh):
    """Natural frequencies [Hz] of a homogeneous free plate, ascending."""
    squares = solve_free_plate(plate, mesh, frequency_max=500.0).modes.eigenvalues
    return np.sqrt(np.sort(squares[squares > 1])) / (2 * np.pi)


@pytest.mark.parametrize("layers", [PANEL, THIN])
def test_free_strip_equals_elasticity(layers):
    """Six modes of a free strip of 375 mm within 0.5 % of plane-strain finite elements.

    One rigidity for all of them is off by -16 to +9 % and by -31 to +16 %.
    """
    expected = strip_frequencies(layers, 0.375, 6)
    found, _ = frequencies_of(panel(layers, width=1.0), (16, 0), parities=((1, 1), (-1, 1)))
    np.testing.assert_allclose(found[:6], expected, rtol=5e-3)


def test_layers_of_one_material_are_the_homogeneous_plate():
    """Three layers of aluminium vibrate as one of their thickness in finite elements, 0.2 %."""
    aluminium = Material("aluminium", E=70e9, rho=2700.0, nu=0.33)
    layers = (LaminateLayer(aluminium, 0.5e-3),) * 3
    found, _ = frequencies_of(panel(layers, 0.3048, 0.2286), (12, 9), cut=500.0)
    plate = Plate(0.3048, 0.2286, 1.5e-3, aluminium)
    mesh = Mesh.accurate(plate, frequency_max=500.0)
    exact = homogeneous_frequencies(plate, mesh)
    np.testing.assert_allclose(found[:9], exact[:9], rtol=2e-3)


def test_complex_modes_equal_a_complex_eigenproblem():
    """Of a core with a loss factor of 1, frequency within 0.1 % and loss within 1 %.

    The eigenvalue of the dynamic stiffness, solved at its own frequency without a modal space.
    """
    plate = panel((PANEL[0], replace(PANEL[1], loss_factor=1.0), PANEL[2]), loss_factor=0.0)
    layered = AtOneFrequency(plate, (10, 8), 150.0)
    modes = layered.modes(
        (1, 1), shift=(2 * np.pi * 30) ** 2, cut=(2 * np.pi * 500) ** 2, band=Band(30.0, 500.0)
    )
    for square, loss in list(zip(modes.eigenvalues, modes.losses, strict=True))[1:4]:
        frequency = np.sqrt(square) / (2 * np.pi)
        D = layered.dynamic_stiffness((1, 1), frequency)
        inertia = plate.material.rho * plate.thickness
        K = D / inertia + square * np.eye(len(D))
        values = linalg.eigvals(K)
        exact = values[np.argmin(np.abs(values - (square + 1j * loss)))]
        assert square == pytest.approx(exact.real, rel=2e-3)
        assert loss == pytest.approx(exact.imag, rel=1e-2)


@pytest.mark.parametrize(
    ("core", "error"),
    [
        pytest.param({}, 1e-3, marks=pytest.mark.long),
        pytest.param({"loss_factor": 0.3}, 0.01, marks=pytest.mark.long),
        ({"by_frequency": ((10.0, 0.5, 0.3), (100.0, 1.0, 0.4), (1000.0, 2.0, 0.5))}, 0.02),
    ],
)
def test_modes_answer_as_the_direct_solution(core, error):
    """Response of the example by its modes against one at each frequency, relative L2."""
    rig = load_rig(EXAMPLE)
    layers = (PANEL[0], replace(PANEL[1], **core), PANEL[2])
    plate = panel(layers, loss_factor=0.01)
    frequencies = np.array([40.0, 150.0, 500.0])
    points = np.array([[0.05, 0.04], [0.2, 0.1], [0.3, 0.2], [0.375, 0.1]])
    free = solve_free_plate(plate, rig.mesh, frequency_max=500.0)
    found = free.acceleration(rig.eras[:2], frequencies, points, loads=rig.masses)
    exact = direct_responder(plate, rig.mesh)(rig.eras[:2], frequencies, points, loads=rig.masses)
    difference = np.linalg.norm(found - exact, axis=2) / np.linalg.norm(exact, axis=2)
    assert difference.max() < error


def test_lossy_layers_damp_in_time_as_at_each_frequency():
    """On soft mounts a mode decays with half its loss factor, that of the free plate's mode."""
    layers = (PANEL[0], replace(PANEL[1], loss_factor=0.3), PANEL[2])
    plate = panel(layers, loss_factor=0.01)
    eras = [
        Era(name, x, y, stiffness=50.0, damping=0.0, bolt_mass=0.0, stroke=1e-4)
        for name, x, y in (("a", 0, 0), ("b", 0.375, 0), ("c", 0, 0.225), ("d", 0.375, 0.225))
    ]
    free = solve_free_plate(plate, SpectralMesh(10, 8, 0.375, 0.225), frequency_max=300.0)
    modes = supported_modes(
        reduce_free_plate(free, footprints_of(eras, ())), eras, frequency_max=250.0
    )
    expected = 0.01 + free.modes.losses / np.maximum(free.modes.eigenvalues, 1.0)
    order = np.argsort(free.modes.eigenvalues)[3:7]
    np.testing.assert_allclose(modes.damping_ratios[3:7], expected[order] / 2, rtol=0.02)


def test_finite_elements_refuse_layers():
    """They would solve another plate, also for a simple support."""
    plate = panel(PANEL)
    with pytest.raises(InputError, match=r"^support must be free or eras"):
        natural_modes(load_rig(EXAMPLE), 3, support="simply-supported")
    with pytest.raises(InputError, match=r"^mesh: must be of polynomials"):
        assemble(plate, Mesh(12, 9, 0.375, 0.225))
