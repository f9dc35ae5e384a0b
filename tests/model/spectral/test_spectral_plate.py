"""The plate in Legendre polynomials, against independent solvers and finite elements."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy import linalg

from long_form import in_turn
from model.errors import InputError
from model.fem import Q5, Mesh
from model.reduction.free_plate import SpectralModes, solve_free_plate
from model.rig.rig_file import mesh_of
from model.spectral.direct_solution import direct_spectral_acceleration
from model.spectral.modes import SpectralMesh, SpectralPlate, local_compliance
from model.spectral.polynomials import CLASSES
from model.structure.attachments import Era, PointLoad
from model.structure.plate import Material, Plate
from model.vibration import natural_modes
from plates import make_paper_rig

RIG = make_paper_rig(12, 9)
PAPER = RIG.plate
GLASS = Material("glass", E=72e9, rho=2500.0, nu=0.23)

# Converged Reissner-Mindlin values [Hz] of the paper's plate: NGSolve, order 5 with resolved edge
# layers; scikit-fem agrees to 0.0013 %.
CONVERGED = {
    "free": [
        *(70.0349, 84.4211, 158.307, 166.542, 203.446, 249.124),
        *(319.32, 340.186, 431.064, 477.535, 482.927, 524.087),
    ],
    "eras": [
        *(31.6186, 67.9034, 75.4567, 106.449, 156.821, 211.972),
        *(214.733, 248.396, 330.943, 357.949, 388.062, 444.871),
    ],
}


def _era(x: float, y: float) -> Era:
    return Era("E", x, y, stiffness=17e3, damping=3.5, bolt_mass=0.0, stroke=1e-4)


def _on_plate(plate: Plate, shares: list[tuple[float, float]]) -> list[Era]:
    return [_era(x * plate.length, y * plate.width) for x, y in shares]


@pytest.mark.parametrize(("support", "within"), [("free", 3e-5), ("eras", 2e-4)])
def test_natural_frequencies_are_those_of_an_independent_solver(support, within):
    """Twelve frequencies of NGSolve, free and on springs at the corners, which are points there."""
    mesh = mesh_of("auto", PAPER, frequency_max=500.0, stiffness=17e3)
    found = natural_modes(RIG, 12, support=support, mesh=mesh)
    np.testing.assert_allclose(found.frequencies, CONVERGED[support], rtol=within)


LAYOUTS = {
    "corners": [(0, 0), (1, 0), (0, 1), (1, 1)],
    "edges": [(0.3, 0), (0.61, 1), (0, 0.44), (1, 0.72)],
    "inside": [(0.21, 0.3), (0.63, 0.11), (0.47, 0.83), (0.9, 0.6)],
    "close together": [(0.21, 0.3), (0.63, 0.11), (0.64, 0.11), (0.9, 0.6)],
}


@pytest.mark.parametrize(
    ("layout", "foot"), in_turn(["corners", "edges", "inside"], [0.002, 0.005, 0.01])
)
def test_response_on_feet_is_that_of_fine_elements(layout, foot):
    """At degrees 12x9 within 0.5 %, at 24x18 within 0.1 %, also of feet that an edge cuts."""
    eras = [replace(era, foot=foot) for era in _on_plate(PAPER, LAYOUTS[layout])]
    frequencies = np.linspace(60.0, 320.0, 14)
    points = np.random.default_rng(3).uniform(0.03, 0.97, (30, 2)) * [PAPER.length, PAPER.width]
    sides = (PAPER.length, PAPER.width)
    meshes = (SpectralMesh(12, 9, *sides), SpectralMesh(24, 18, *sides))
    low, high, exact = (
        solve_free_plate(PAPER, mesh, frequency_max=320.0).acceleration(eras, frequencies, points)
        for mesh in (*meshes, Mesh(16, 12, *sides, Q5, 0.002))
    )
    size = np.linalg.norm(exact)
    assert np.linalg.norm(low - exact) / size < 0.005
    assert np.linalg.norm(high - exact) / size < 0.001


@pytest.mark.parametrize("foot", [0.0, 0.004])
@pytest.mark.parametrize("layout", ["corners", "inside", "close together"])
def test_reduction_equals_direct_solution(layout, foot):
    """Modes and truncated ones against a solution of all unknowns at each frequency, 1e-5."""
    eras = [replace(era, foot=foot) for era in _on_plate(PAPER, LAYOUTS[layout])]
    loads = [PointLoad(0.1, 0.05, 2e3, 1.0, 0.01)]
    frequencies = np.array([45.0, 106.4, 250.0, 480.0])
    points = np.random.default_rng(1).uniform(0.01, 0.2, (25, 2))
    mesh = SpectralMesh(12, 9, PAPER.length, PAPER.width)
    free = solve_free_plate(PAPER, mesh, frequency_max=500.0)
    found = free.acceleration(eras, frequencies, points, loads=loads)
    exact = direct_spectral_acceleration(PAPER, mesh, eras, frequencies, points, loads=loads)
    error = np.linalg.norm(found - exact, axis=2) / np.linalg.norm(exact, axis=2)
    assert error.max() < 1e-5


PLATES = {
    "paper": PAPER,
    "glass panel": Plate(0.36, 0.22, 0.0011, GLASS),
    "strip": Plate(0.5, 0.1, 0.0015, GLASS),
}


@pytest.mark.parametrize(
    ("plate", "degrees", "frequency"),
    [("paper", (12, 9), 640.0), ("glass panel", (18, 12), 1000.0), ("strip", (16, 6), 2000.0)],
)
def test_modes_are_those_of_a_full_eigen_solution(plate, degrees, frequency):
    """LAPACK on all unknowns of each class finds the same modes below a cut-off, and no others."""
    of = PLATES[plate]
    mesh = SpectralMesh(*degrees, of.length, of.width)
    modes = SpectralModes(
        of,
        mesh,
        shift=(2 * math.pi * 30) ** 2,
        cutoff_frequency=frequency,
        frequency_max=frequency,
    )
    every = np.concatenate([_all_eigenvalues(of, degrees, each) for each in CLASSES])
    expected = np.sqrt(np.maximum(every, 0)) / (2 * math.pi)
    found = np.sqrt(np.sort(modes.eigenvalues)) / (2 * math.pi)
    np.testing.assert_allclose(found, np.sort(expected[expected < frequency]), rtol=1e-5, atol=0.1)


def _all_eigenvalues(plate: Plate, degrees, parity) -> np.ndarray:
    """omega² of all unknowns of a class, displacements along the plate with their inertia."""
    spectral = SpectralPlate(plate, degrees, 150.0)
    of = spectral.functions(parity)
    K = spectral._stiffness(of, [plate.material.E])
    M = plate.material.rho * plate.thickness * np.eye(of.size)
    M[of.deflections :, of.deflections :] /= 6  # of opposite unit motions
    return linalg.eigvalsh(K, M)


@pytest.mark.parametrize(
    ("low", "tolerances"),
    in_turn([(12, 9), (13, 10)], [(1.5e-3, 0.0, 0.05, 0.12), (1e-2, 5e-3, 0.25, 0.35)]),
)
def test_local_compliance_is_what_higher_degrees_add(low, tolerances):
    """Within 5 % of the receptance that degrees 48x36 add under points inside, odd or even.

    Within 12 % near edges, and 25 % and 35 % on feet on a plate so thick that shear matters most.
    """
    thickness, foot, inside, at_edges = tolerances
    plate = Plate(PAPER.length, PAPER.width, thickness, PAPER.material)
    rng = np.random.default_rng(7)
    sides = np.array([plate.length, plate.width])
    points = rng.uniform(0.15, 0.85, (12, 2)) * sides
    points[4:6], points[6:8, 0] = [sides / 2, sides * [0.5, 0.3]], [0.0, 0.003]
    points[8:10, 1] = sides[1] - [0.0, 0.003]
    footprints = np.column_stack([points, np.full(len(points), foot)])
    without, local = [], []
    for degrees in (low, (48, 36)):
        free = solve_free_plate(plate, SpectralMesh(*degrees, *sides), frequency_max=100.0)
        own, _ = free.receptances(footprints, points, np.array([50.0]))
        local.append(np.diagonal(local_compliance(plate, degrees, footprints, footprints)))
        without.append(np.diagonal(own[0]).real - local[-1])
    added, expected = without[1] - without[0], local[0] - local[1]
    is_at_edge = (np.arange(12) >= 6) & (np.arange(12) < 10)
    np.testing.assert_allclose(added[~is_at_edge], expected[~is_at_edge], rtol=inside)
    np.testing.assert_allclose(added[is_at_edge], expected[is_at_edge], rtol=at_edges)


def test_more_accuracy_and_stiffer_eras_take_higher_degrees():
    """A harder spring dents the plate more, one on a foot less; auto is for 1 %."""

    def degrees(text: str, stiffness: float, foot: float = 0.0) -> int:
        mesh = mesh_of(text, PAPER, frequency_max=320.0, stiffness=stiffness, foot=foot)
        return mesh.nx

    assert degrees("auto 5 %", 0.0) <= degrees("auto 1 %", 0.0) < degrees("auto 0.1 %", 0.0)
    assert degrees("auto 2 %", 17e3) < degrees("auto 1 %", 17e3)
    assert degrees("auto 0.1 %", 17e3, foot=0.005) < degrees("auto 0.1 %", 17e3)
    assert degrees("auto 1 %", 17e3) < degrees("auto 1 %", 500e3)
    assert degrees("auto", 500e3) == degrees("auto 1 %", 500e3)
    assert degrees("auto", 1e9) < 80


def test_plate_of_many_wavelengths_takes_one_high_degree():
    """4 m of glass 0.7 mm thick and 0.1 m wide have 34 wavelengths: high along it, low across."""
    mesh = mesh_of("auto", Plate(4.0, 0.1, 0.0007, GLASS), frequency_max=500.0)
    assert isinstance(mesh, SpectralMesh)
    assert mesh.nx > 110
    assert mesh.ny < 20


@pytest.mark.parametrize("text", ["auto", "auto 5 %", "120x90 Legendre", "600x600", "120x120 Q5"])
def test_meshes_that_would_take_minutes_or_all_memory_are_refused(text):
    """Ten metres square of glass 2 mm thick, and meshes that are named."""
    with pytest.raises(InputError):
        mesh_of(text, Plate(10.0, 10.0, 0.002, GLASS), frequency_max=500.0)


@pytest.mark.parametrize(
    "text",
    [
        "3x9 Legendre",
        "201x9 Legendre",
        "12x9 legendre",
        "auto 1",
        "auto 0 %",
        "auto 50 %",
        "auto x %",
    ],
)
def test_degrees_and_accuracies_out_of_range_are_refused(text):
    """Degrees below 4 and above 200, accuracies below 0.05 % and above 10 %, other spellings."""
    with pytest.raises(InputError):
        mesh_of(text, PAPER, frequency_max=500.0)
