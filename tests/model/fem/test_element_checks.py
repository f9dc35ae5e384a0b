"""The checks of plate elements: ours keep them all, and each fault is found by the check for it."""

import numpy as np
import pytest

from element_checks import CHECKS, DX, DY, PLATE, frequency_error, rate
from model.arrays import FloatArray
from model.fem.mesh import ELEMENTS, MITC4, Q3, Element, rigidities

_CORNERS = np.array([[-1.0, -1.0], [1.0, -1.0], [-1.0, 1.0], [1.0, 1.0]])
_GAUSS = np.array([[s, t] for t in (-1, 1) for s in (-1, 1)]) / np.sqrt(3)


def _shape(xi: float, eta: float) -> FloatArray:
    """Bilinear shape functions of the four nodes, (4,)."""
    return 0.25 * (1 + _CORNERS[:, 0] * xi) * (1 + _CORNERS[:, 1] * eta)


def _shape_gradient(xi: float, eta: float, dx: float, dy: float) -> tuple[FloatArray, FloatArray]:
    """Their derivatives along x and y [1/m], (4,) each."""
    along_x = 0.25 * _CORNERS[:, 0] * (1 + _CORNERS[:, 1] * eta) * 2 / dx
    along_y = 0.25 * _CORNERS[:, 1] * (1 + _CORNERS[:, 0] * xi) * 2 / dy
    return along_x, along_y


def _curvature(xi: float, eta: float, dx: float, dy: float) -> FloatArray:
    """Rows d(beta_x)/dx, d(beta_y)/dy, d(beta_x)/dy + d(beta_y)/dx of the 12 dof (paper Eq. 5)."""
    along_x, along_y = _shape_gradient(xi, eta, dx, dy)
    rows = np.zeros((3, 12))
    rows[0, 1::3] = along_x
    rows[1, 2::3] = along_y
    rows[2, 1::3] = along_y
    rows[2, 2::3] = along_x
    return rows


def _shear(xi: float, eta: float, dx: float, dy: float) -> FloatArray:
    """Rows dw/dx - beta_x and dw/dy - beta_y of the 12 dof (paper Eq. 3)."""
    along_x, along_y = _shape_gradient(xi, eta, dx, dy)
    shape = _shape(xi, eta)
    rows = np.zeros((2, 12))
    rows[0, 0::3] = along_x
    rows[0, 1::3] = -shape
    rows[1, 0::3] = along_y
    rows[1, 2::3] = -shape
    return rows


def _assumed_shear(xi: float, eta: float, dx: float, dy: float) -> FloatArray:
    """The shear strain tied at the middles of the sides and linear between opposite ones."""
    below, above = _shear(0, -1, dx, dy)[0], _shear(0, 1, dx, dy)[0]
    left, right = _shear(-1, 0, dx, dy)[1], _shear(1, 0, dx, dy)[1]
    return np.stack(
        [
            0.5 * (1 - eta) * below + 0.5 * (1 + eta) * above,
            0.5 * (1 - xi) * left + 0.5 * (1 + xi) * right,
        ]
    )


def wrong(element: Element, **methods) -> Element:
    """An element with other methods."""
    return type("Wrong", (Element,), methods)(element.name, element.side)


def test_mitc4_ties_its_shear_at_the_middles_of_its_sides() -> None:
    """By definition (Bathe and Dvorkin 1985), integrated at 2 x 2 points."""
    bending, shear, _ = rigidities(PLATE)
    total = np.zeros((12, 12))
    for xi, eta in _GAUSS:
        curvature, strain = _curvature(xi, eta, DX, DY), _assumed_shear(xi, eta, DX, DY)
        total += (curvature.T @ bending @ curvature + shear * strain.T @ strain) * DX * DY / 4
    found = MITC4.stiffness(PLATE, DX, DY)
    np.testing.assert_allclose(found, total, atol=1e-12 * np.abs(total).max())


def test_own_elements_pass_all_checks() -> None:
    """No check finds a problem in any element."""
    found = {
        (name, check.name): check.problem(element)
        for name, element in ELEMENTS.items()
        for check in CHECKS
    }
    assert {key: problem for key, problem in found.items() if problem} == {}


def locking(self, plate, dx, dy):
    """The stiffness of MITC4 with its shear integrated fully in place of tied."""
    bending, shear, _ = rigidities(plate)
    total = np.zeros((12, 12))
    for xi, eta in _GAUSS:
        curvature, strain = _curvature(xi, eta, dx, dy), _shear(xi, eta, dx, dy)
        total += (curvature.T @ bending @ curvature + shear * strain.T @ strain) * dx * dy / 4
    return total


def one_point(self, plate, dx, dy):
    """The stiffness with shear at the middle alone: it has spurious modes."""
    bending, shear, _ = rigidities(plate)
    strain = _shear(0.0, 0.0, dx, dy)
    total = dx * dy * shear * strain.T @ strain
    for xi, eta in _GAUSS:
        curvature = _curvature(xi, eta, dx, dy)
        total += curvature.T @ bending @ curvature * dx * dy / 4
    return total


def skewed(self, plate, dx, dy):
    """The right stiffness with a bit more at one of its corners."""
    found = MITC4.stiffness(plate, dx, dy)
    found[0, 0] *= 1.01
    return found


def scaled(method, factor):
    """A method of which the result is so many times as large."""
    return lambda self, plate, dx, dy: factor * method(plate, dx, dy)


FAULTS = {
    "nodes": Element("Q3", (-1.0, -0.4, 0.5, 1.0)),
    "matrices": wrong(MITC4, mass=scaled(MITC4.mass, 0.0)),
    "mirror": wrong(MITC4, stiffness=skewed),
    "rigid_motions": wrong(MITC4, stiffness=lambda self, *of: MITC4.stiffness(*of) + np.eye(12)),
    "no_other_free_motion": wrong(MITC4, stiffness=one_point),
    "bending": wrong(Q3, stiffness=scaled(Q3.stiffness, 1.01)),
    "shear": wrong(MITC4, stiffness=lambda self, *of: MITC4.stiffness(*of) + one_point(self, *of)),
    "inertia": wrong(MITC4, mass=scaled(MITC4.mass, 1.01)),
    "convergence": wrong(MITC4, stiffness=locking),
}


@pytest.mark.parametrize(("name", "element"), FAULTS.items(), ids=FAULTS)
def test_check_finds_its_fault(name: str, element: Element) -> None:
    """The check for it says what is wrong."""
    (check,) = (check for check in CHECKS if check.name == name)
    assert check.problem(element) is not None


def test_every_check_has_a_fault() -> None:
    """Each check of elements is seen to fail, by an element made wrong for it; none is left out."""
    assert FAULTS.keys() == {check.name for check in CHECKS}


@pytest.mark.parametrize(("name", "expected"), [("MITC4", 2.0), ("Q3", 4.0), ("Q4", 6.0)])
def test_elements_converge_with_theoretical_rates(name: str, expected: float) -> None:
    """A frequency errs as the energy does (Strang and Fix, ch. 6).

    By h² where rotations are linear; by h^2(p - 1) where slopes and rotations of order p are made
    equal by being thin alone.
    """
    # With 8 elements a side Q4 errs by 7e-9 of a thin plate's frequency, no more than by rounding.
    errors = [frequency_error(ELEMENTS[name], count) for count in (3, 6)]
    assert rate(*errors) == pytest.approx(expected, abs=0.15)
