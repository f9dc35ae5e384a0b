"""The MITC4 element matrices, against what any plate element must do."""

import numpy as np
import pytest

from model.elements import mitc4
from model.plate import Plate
from paper_plate import ALUMINIUM

DX, DY = 0.03, 0.02
CORNERS = np.array([[0, 0], [DX, 0], [0, DY], [DX, DY]])
PLATE = Plate(1.0, 1.0, 0.002, ALUMINIUM)


def nodal(w, beta_x, beta_y):
    """Degrees of freedom from three fields given as functions of x and y."""
    return np.array([[w(x, y), beta_x(x, y), beta_y(x, y)] for x, y in CORNERS]).ravel()


RIGID_MOTIONS = {
    "up": nodal(lambda x, y: 1.0, lambda x, y: 0.0, lambda x, y: 0.0),
    "tilt about y": nodal(lambda x, y: x, lambda x, y: 1.0, lambda x, y: 0.0),
    "tilt about x": nodal(lambda x, y: y, lambda x, y: 0.0, lambda x, y: 1.0),
}


@pytest.mark.parametrize("motion", RIGID_MOTIONS)
def test_rigid_motion_costs_no_energy(motion):
    """A plate element moved as a rigid body feels no force."""
    stiffness = mitc4.stiffness(PLATE, DX, DY)
    force = stiffness @ RIGID_MOTIONS[motion]
    assert np.abs(force).max() < 1e-9 * np.abs(stiffness).max()


def test_only_rigid_motions_are_free():
    """Exactly three motions of an element cost nothing: no spurious mode can hide in it."""
    energies = np.linalg.eigvalsh(mitc4.stiffness(PLATE, DX, DY))
    assert (energies > 1e-9 * energies[-1]).sum() == 9


def test_constant_curvature_has_the_energy_of_thin_plate_theory():
    """Cylindrical bending w = kappa x²/2 stores D kappa² / 2 per area: no shear locking."""
    kappa = 0.7
    bent = nodal(lambda x, y: kappa * x**2 / 2, lambda x, y: kappa * x, lambda x, y: 0.0)
    energy = bent @ mitc4.stiffness(PLATE, DX, DY) @ bent / 2
    rigidity = 70e9 * 0.002**3 / (12 * (1 - 0.33**2))
    assert energy == pytest.approx(rigidity * kappa**2 / 2 * DX * DY, rel=1e-12)


def test_pure_twist_has_the_energy_of_thin_plate_theory():
    """Twist w = kappa x y stores D (1 - nu) kappa² per area."""
    kappa = 0.7
    twisted = nodal(lambda x, y: kappa * x * y, lambda x, y: kappa * y, lambda x, y: kappa * x)
    energy = twisted @ mitc4.stiffness(PLATE, DX, DY) @ twisted / 2
    rigidity = 70e9 * 0.002**3 / (12 * (1 - 0.33**2))
    assert energy == pytest.approx(rigidity * (1 - 0.33) * kappa**2 * DX * DY, rel=1e-12)


def test_constant_shear_has_the_energy_of_the_shear_correction():
    """Pure shear, w = gamma x without rotation, stores kappa G h gamma² / 2 per area."""
    gamma = 0.01
    sheared = nodal(lambda x, y: gamma * x, lambda x, y: 0.0, lambda x, y: 0.0)
    energy = sheared @ mitc4.stiffness(PLATE, DX, DY) @ sheared / 2
    shear_modulus = 70e9 / (2 * 1.33)
    expected = 5 / 6 * shear_modulus * 0.002 * gamma**2 / 2 * DX * DY
    assert energy == pytest.approx(expected, rel=1e-12)


def test_mass_moves_as_one_body():
    """Moved up and down, an element weighs rho h dx dy; tilted, it has its rotary inertia."""
    mass = mitc4.mass(PLATE, DX, DY)
    up = RIGID_MOTIONS["up"]
    assert up @ mass @ up == pytest.approx(2700 * 0.002 * DX * DY, rel=1e-12)
    turn = nodal(lambda x, y: 0.0, lambda x, y: 1.0, lambda x, y: 0.0)
    assert turn @ mass @ turn == pytest.approx(2700 * 0.002**3 / 12 * DX * DY, rel=1e-12)
