"""Plates in polynomials: stiff mounts, and the functions themselves."""

import math

import numpy as np
import pytest
from scipy import special
from scipy.integrate import trapezoid

from model.reduction.free_plate import solve_free_plate
from model.spectral.modes import SpectralMesh
from model.spectral.polynomials import EVEN, EdgedFunctions
from plates import make_paper_rig

PLATE = make_paper_rig(12, 9).plate
SIDES = (PLATE.length, PLATE.width)


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
    shear = 5 / 6 * PLATE.material.E / (2 * (1 + PLATE.material.nu)) * PLATE.thickness
    compliance = 1 / (PLATE.flexural_rigidity * k**4) + 1 / (shear * k**2)
    expected = trapezoid(shapes * compliance * k**2 / (2 * math.pi), np.log(k))  # k d ln k = dk
    assert weights @ np.diagonal(between[0]).real == pytest.approx(expected, rel=0.02)


LENGTH, DECAY = 0.3, 2000.0


def test_a_layer_that_polynomials_resolve_is_left_out():
    """On a plate as thick as long, degree 24 has the layer's function already."""
    assert EdgedFunctions(LENGTH, 24, (3 / LENGTH,)).count(EVEN) == 13
    assert EdgedFunctions(LENGTH, 24, (DECAY,)).count(EVEN) == 14
