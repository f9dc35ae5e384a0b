"""The plate as soft under forces as its polynomials leave possible."""

import math
from dataclasses import replace

import numpy as np
import pytest

from model.reduction.free_plate import solve_free_plate
from model.reduction.reduced_plate import reduce_free_plate
from model.reduction.spectral_modes import SpectralModes
from model.spectral.local_compliance import local_compliance
from model.spectral.mesh import SpectralMesh
from paper_plate import LENGTH, WIDTH, make_paper_rig

PLATE = replace(make_paper_rig(12, 9).plate, loss_factor=0.0)
PLACES = np.array([(0.13, 0.11, 0), (0.17, 0, 0), (LENGTH, WIDTH, 0), (0.05, 0.06, 0.01)])

# ln 10 / (2 pi kappa G h) with kappa 5/6 and G = 70 GPa / 2.66, at a point inside; on an edge and
# at a corner its images double it once and twice; a disc ends the logarithm.
DECADE = math.log(10) / (2 * math.pi * 5 / 6 * 70e9 / 2.66 * 0.0015)
DECADES = DECADE * np.array([1, 2, 4, 0])


def plates():
    """The paper's plate without damping in polynomials, and the softer one."""
    free = solve_free_plate(PLATE, SpectralMesh(12, 9, LENGTH, WIDTH), frequency_max=500.0)
    assert isinstance(free.modes, SpectralModes)
    return free, replace(free, modes=free.modes.softer())


def test_softer_plate_gives_way_by_a_fifth_and_a_decade_more():
    """Under slow forces: a fifth of the unresolved compliance, and a decade under points."""
    free, softer = plates()
    (stiff, to_points), (soft, to_softer_points) = (
        plate.receptances(PLACES, PLACES, np.array([5.0])) for plate in (free, softer)
    )
    assert pytest.approx(1.1e-8, rel=0.05) == DECADE
    expected = 0.2 * local_compliance(PLATE, (12, 9), PLACES, PLACES) + np.diag(DECADES)
    np.testing.assert_allclose((soft - stiff)[0].real, expected, rtol=1e-3, atol=1e-13)
    np.testing.assert_allclose(
        (to_softer_points - to_points)[0].real, expected, rtol=1e-3, atol=1e-13
    )


def test_softer_plate_can_be_reduced():
    """Its reduction has the same receptance, as that of the plate itself."""
    _, softer = plates()
    exact, _ = softer.receptances(PLACES, PLACES, np.array([5.0]))
    reduced = reduce_free_plate(softer, PLACES)
    shapes = reduced.at(PLACES)
    found = shapes / (reduced.omega**2 - (10 * math.pi) ** 2) @ shapes.T
    np.testing.assert_allclose(found, exact[0].real, rtol=1e-5)
