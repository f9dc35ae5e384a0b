"""The checks of plate elements: ours keep them all, and each fault is found by the check for it."""

from dataclasses import replace

import numpy as np
import pytest

from element_checks import CHECKS, frequency_error, rate
from model.fem.elements import ELEMENTS, Element
from model.fem.elements.lagrange import Q3
from model.fem.elements.mitc4 import MITC4, _curvature, _shear, rigidities


def test_own_elements_pass_all_checks() -> None:
    """No check finds a problem in any element."""
    found = {
        (name, check.name): check.problem(element)
        for name, element in ELEMENTS.items()
        for check in CHECKS
    }
    assert {key: problem for key, problem in found.items() if problem} == {}


def locking(plate, dx, dy):
    """The stiffness of MITC4 with its shear integrated fully in place of tied."""
    bending, shear, _ = rigidities(plate)
    total = np.zeros((12, 12))
    for xi in (-(3**-0.5), 3**-0.5):
        for eta in (-(3**-0.5), 3**-0.5):
            curvature, strain = _curvature(xi, eta, dx, dy), _shear(xi, eta, dx, dy)
            total += (curvature.T @ bending @ curvature + shear * strain.T @ strain) * dx * dy / 4
    return total


def one_point(plate, dx, dy):
    """The stiffness with shear at the middle alone: it has spurious modes."""
    bending, shear, _ = rigidities(plate)
    strain = _shear(0.0, 0.0, dx, dy)
    total = dx * dy * shear * strain.T @ strain
    for xi in (-(3**-0.5), 3**-0.5):
        for eta in (-(3**-0.5), 3**-0.5):
            curvature = _curvature(xi, eta, dx, dy)
            total += curvature.T @ bending @ curvature * dx * dy / 4
    return total


def skewed(plate, dx, dy):
    """The right stiffness with a bit more at one of its corners."""
    wrong = MITC4.stiffness(plate, dx, dy)
    wrong[0, 0] *= 1.01
    return wrong


FAULTS = {
    "nodes": replace(Q3, side=(-1.0, -0.4, 0.5, 1.0)),
    "matrices": replace(MITC4, mass=lambda plate, dx, dy: np.zeros((12, 12))),
    "mirror": replace(MITC4, stiffness=skewed),
    "rigid_motions": replace(
        MITC4, stiffness=lambda plate, dx, dy: MITC4.stiffness(plate, dx, dy) + np.eye(12)
    ),
    "no_other_free_motion": replace(MITC4, stiffness=one_point),
    "bending": replace(Q3, stiffness=lambda plate, dx, dy: 1.01 * Q3.stiffness(plate, dx, dy)),
    "shear": replace(
        MITC4,
        stiffness=lambda plate, dx, dy: MITC4.stiffness(plate, dx, dy) + one_point(plate, dx, dy),
    ),
    "inertia": replace(MITC4, mass=lambda plate, dx, dy: 1.01 * MITC4.mass(plate, dx, dy)),
    "convergence": replace(MITC4, stiffness=locking),
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
