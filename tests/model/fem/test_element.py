"""The element matrices, against what any plate element must do; for every element there is."""

import numpy as np
import pytest

from model.fem.elements import ELEMENTS, Element
from model.structure.plate import Plate
from paper_plate import ALUMINIUM

DX, DY = 0.03, 0.02
PLATE = Plate(1.0, 1.0, 0.002, ALUMINIUM)
RIGIDITY = 70e9 * 0.002**3 / (12 * (1 - 0.33**2))


@pytest.fixture(params=ELEMENTS.values(), ids=ELEMENTS)
def element(request: pytest.FixtureRequest) -> Element:
    """Each element in turn."""
    return request.param


def nodal(element, w, beta_x, beta_y):
    """Degrees of freedom from three fields given as functions of x and y."""
    side = (1 + np.array(element.side)) / 2
    corners = [(DX * x, DY * y) for y in side for x in side]
    return np.array([[w(x, y), beta_x(x, y), beta_y(x, y)] for x, y in corners]).ravel()


RIGID_MOTIONS = {
    "up": (lambda x, y: 1.0, lambda x, y: 0.0, lambda x, y: 0.0),
    "tilt about y": (lambda x, y: x, lambda x, y: 1.0, lambda x, y: 0.0),
    "tilt about x": (lambda x, y: y, lambda x, y: 0.0, lambda x, y: 1.0),
}


@pytest.mark.parametrize("motion", RIGID_MOTIONS)
def test_rigid_motion_costs_no_energy(element, motion):
    """A plate element moved as a rigid body feels no force."""
    stiffness = element.stiffness(PLATE, DX, DY)
    force = stiffness @ nodal(element, *RIGID_MOTIONS[motion])
    assert np.abs(force).max() < 1e-9 * np.abs(stiffness).max()


def test_only_rigid_motions_are_free(element):
    """Exactly three motions of an element cost nothing: no spurious mode can hide in it."""
    energies = np.linalg.eigvalsh(element.stiffness(PLATE, DX, DY))
    assert (energies > 1e-9 * energies[-1]).sum() == 3 * (element.order + 1) ** 2 - 3


def test_matrices_are_symmetric(element):
    """Stiffness and mass come from an energy each."""
    for matrix in (element.stiffness(PLATE, DX, DY), element.mass(PLATE, DX, DY)):
        np.testing.assert_allclose(matrix, matrix.T, atol=1e-12 * np.abs(matrix).max())


def test_constant_curvature_has_the_energy_of_thin_plate_theory(element):
    """Cylindrical bending w = kappa x²/2 stores D kappa² / 2 per area: no shear locking."""
    kappa = 0.7
    for bent, area in (
        ((lambda x, y: kappa * x**2 / 2, lambda x, y: kappa * x, lambda x, y: 0.0), DX * DY),
        ((lambda x, y: kappa * y**2 / 2, lambda x, y: 0.0, lambda x, y: kappa * y), DX * DY),
    ):
        field = nodal(element, *bent)
        energy = field @ element.stiffness(PLATE, DX, DY) @ field / 2
        assert energy == pytest.approx(RIGIDITY * kappa**2 / 2 * area, rel=1e-10)


def test_a_saddle_has_the_energy_of_thin_plate_theory(element):
    """Curvatures kappa and -kappa store D (1 - nu) kappa²: Poisson's ratio couples them."""
    kappa = 0.7
    saddle = nodal(
        element,
        lambda x, y: kappa * (x**2 - y**2) / 2,
        lambda x, y: kappa * x,
        lambda x, y: -kappa * y,
    )
    energy = saddle @ element.stiffness(PLATE, DX, DY) @ saddle / 2
    assert energy == pytest.approx(RIGIDITY * (1 - 0.33) * kappa**2 * DX * DY, rel=1e-10)


def test_pure_twist_has_the_energy_of_thin_plate_theory(element):
    """Twist w = kappa x y stores D (1 - nu) kappa² per area."""
    kappa = 0.7
    twisted = nodal(
        element, lambda x, y: kappa * x * y, lambda x, y: kappa * y, lambda x, y: kappa * x
    )
    energy = twisted @ element.stiffness(PLATE, DX, DY) @ twisted / 2
    assert energy == pytest.approx(RIGIDITY * (1 - 0.33) * kappa**2 * DX * DY, rel=1e-10)


def test_constant_shear_has_the_energy_of_the_shear_correction(element):
    """Pure shear, w = gamma x without rotation, stores kappa G h gamma² / 2 per area."""
    gamma = 0.01
    sheared = nodal(element, lambda x, y: gamma * x, lambda x, y: 0.0, lambda x, y: 0.0)
    energy = sheared @ element.stiffness(PLATE, DX, DY) @ sheared / 2
    shear_modulus = 70e9 / (2 * 1.33)
    expected = 5 / 6 * shear_modulus * 0.002 * gamma**2 / 2 * DX * DY
    assert energy == pytest.approx(expected, rel=1e-10)


def test_mass_moves_as_one_body(element):
    """Moved up and down, an element weighs rho h dx dy; tilted, it has its rotary inertia."""
    mass = element.mass(PLATE, DX, DY)
    up = nodal(element, *RIGID_MOTIONS["up"])
    assert up @ mass @ up == pytest.approx(2700 * 0.002 * DX * DY, rel=1e-12)
    turn = nodal(element, lambda x, y: 0.0, lambda x, y: 1.0, lambda x, y: 0.0)
    assert turn @ mass @ turn == pytest.approx(2700 * 0.002**3 / 12 * DX * DY, rel=1e-12)


def test_shape_functions_are_one_at_their_node_and_zero_at_the_others(element):
    """And everywhere they add up to one."""
    nodes = np.array(element.side)
    np.testing.assert_allclose(element.shape(nodes), np.eye(len(nodes)), atol=1e-12)
    between = element.shape(np.linspace(-1, 1, 17))
    np.testing.assert_allclose(between.sum(axis=1), 1.0, rtol=1e-12)


@pytest.mark.parametrize(("name", "side"), [("Q3", 0.2**0.5), ("Q4", (3 / 7) ** 0.5)])
def test_nodes_of_high_order_are_those_of_gauss_and_lobatto(name, side):
    """Abramowitz and Stegun, Table 25.6: the outermost inner nodes are 0.2^½ and (3/7)^½."""
    assert ELEMENTS[name].side[-2] == pytest.approx(side, rel=1e-14)
