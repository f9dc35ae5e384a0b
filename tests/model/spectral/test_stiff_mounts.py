"""Plates in polynomials: stiff mounts, and the functions themselves."""

import math

import numpy as np
import pytest
from scipy import special
from scipy.integrate import trapezoid

from model.fem.mesh import Mesh, element_of
from model.reduction.free_plate import solve_free_plate
from model.spectral.functions import EVEN, EdgedFunctions
from model.spectral.mesh import SpectralMesh
from model.structure.attachments import Era
from paper_plate import make_paper_rig

PLATE = make_paper_rig(12, 9).plate
SIDES = (PLATE.length, PLATE.width)


def mounts(stiffness, foot):
    """Four mounts 30 mm within the corners."""
    x, y = (0.03, PLATE.length - 0.03), (0.03, PLATE.width - 0.03)
    places = [(a, b) for a in x for b in y]
    return [
        Era(str(n), *at, stiffness=stiffness, damping=2.0, bolt_mass=0.0, stroke=1e-4, foot=foot)
        for n, at in enumerate(places)
    ]


@pytest.fixture(scope="module")
def elements():
    """The plate in elements of fifth order, 5 mm between their nodes."""
    mesh = Mesh(12, 9, *SIDES, element=element_of("Q5"), strip=3e-3)
    return solve_free_plate(PLATE, mesh, frequency_max=400.0)


@pytest.mark.long
@pytest.mark.parametrize("stiffness", [1e6, 1e8])
def test_response_on_stiff_patches_is_that_of_elements(stiffness, elements):
    """Of 5 mm within 0.5 % of elements that resolve it; a point is 1.2 to 3 % off at 400 Hz."""
    mesh = SpectralMesh.accurate(
        PLATE, frequency_max=400.0, accuracy=0.01, stiffness=stiffness, foot=5e-3
    )
    frequencies = np.array([110.0, 250.0, 400.0])
    points = np.random.default_rng(3).uniform(0.05, 0.95, (30, 2)) * SIDES
    free = solve_free_plate(PLATE, mesh, frequency_max=400.0)
    found, point = (
        free.acceleration(mounts(stiffness, foot), frequencies, points) for foot in (5e-3, 0.0)
    )
    exact = elements.acceleration(mounts(stiffness, 5e-3), frequencies, points)
    size = np.linalg.norm(exact, axis=2)
    assert (np.linalg.norm(found - exact, axis=2) / size).max() < 0.005
    at_400 = (np.linalg.norm(point - exact, axis=2) / size)[2].max()
    assert 0.012 < at_400 < 0.03


def test_patches_dent_as_the_infinite_plate_says():
    """Receptances of discs of 2, 5 and 10 mm in the middle of the plate, within 2 %.

    In a sum of weights w with sum w = 0 and sum w a² = 0 all waves longer than the discs drop out.
    Uniform pressure on a disc and the mean deflection there, by Hankel's transform of the static
    Mindlin plate: the integral of (2 J1(ka) / ka)² (1 / D k⁴ + 1 / S k²) k / 2 pi.
    """
    middle, radii = [PLATE.length / 2, PLATE.width / 2], np.array([2e-3, 5e-3, 10e-3])
    free = solve_free_plate(PLATE, SpectralMesh(36, 28, *SIDES), frequency_max=200.0)
    places = np.array([[*middle, radius] for radius in radii])
    between, _ = free.receptances(places, np.array([middle]), np.array([60.0]))
    weights = np.array([1.0, *np.linalg.solve([[1, 1], radii[1:] ** 2], [-1, -(radii[0] ** 2)])])
    k = np.exp(np.linspace(math.log(1e-1), math.log(1e6), 100_000))
    shapes = weights @ [(2 * special.j1(k * a) / (k * a)) ** 2 for a in radii]
    shear = 5 / 6 * PLATE.material.shear_modulus * PLATE.thickness
    compliance = 1 / (PLATE.flexural_rigidity * k**4) + 1 / (shear * k**2)
    expected = trapezoid(shapes * compliance * k**2 / (2 * math.pi), np.log(k))  # k d ln k = dk
    assert weights @ np.diagonal(between[0]).real == pytest.approx(expected, rel=0.02)


LENGTH, DECAY = 0.3, 2000.0


def test_a_layer_that_polynomials_resolve_is_left_out():
    """On a plate as thick as long, degree 24 has the layer's function already."""
    assert EdgedFunctions(LENGTH, 24, (3 / LENGTH,)).count(EVEN) == 13
    assert EdgedFunctions(LENGTH, 24, (DECAY,)).count(EVEN) == 14
