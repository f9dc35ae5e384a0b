"""The complex response to ERAs, against hand calculation and physics."""

from dataclasses import replace

import numpy as np

from model.fem.plate import assemble, direct_acceleration
from model.reduction.free_plate import solve_free_plate
from model.structure.attachments import Era, footprints_of


def test_direct_acceleration_of_a_rigid_plate_equals_mass_on_springs(coarse_rig):
    """Driven evenly, a plate 20 mm thick follows the one-mass transmissibility by hand."""
    plate = replace(coarse_rig.plate, thickness=0.020)
    soft = tuple(Era(e.name, e.x, e.y, 500.0, 2.0, 0.003, 1e-4) for e in coarse_rig.eras)
    omega = 2 * np.pi * 8.0
    matrices = assemble(plate, coarse_rig.mesh)
    response = direct_acceleration(matrices, soft, np.array([8.0]), coarse_rig.mesh.nodes)
    mass = plate.mass + 4 * 0.003
    spring = 4 * (500.0 + 1j * omega * 2.0)
    by_hand = -(omega**2) * 1e-4 * spring / (spring - omega**2 * mass)
    np.testing.assert_allclose(response[0].sum(axis=0), by_hand, rtol=2e-3)


def test_direct_acceleration_is_reciprocal(fine_rig):
    """What SW's force does at NE, NE's does at SW; with equal ERAs the matrix is symmetric."""
    points = footprints_of(fine_rig.eras)
    free = solve_free_plate(fine_rig.plate, fine_rig.mesh)
    at_eras = free.acceleration(fine_rig.eras, np.array([110.0, 250.0]), points)
    np.testing.assert_allclose(at_eras, at_eras.transpose(0, 2, 1), rtol=1e-9)
