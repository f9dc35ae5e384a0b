"""Supports, loads at points and under fingertips, and the areas that they have."""

import math
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.direct_plate import direct_responder
from model.arrays import FloatArray
from model.errors import InputError
from model.fem import Mesh
from model.reduction.free_plate import solve_free_plate
from model.structure.attachments import (
    Era,
    Fingertip,
    PointLoad,
    check_supported,
    mean_over,
    rigid_body_frequencies,
    support_problem,
)
from model.structure.plate import Material, Plate
from plates import ALUMINIUM, LENGTH, WIDTH, make_paper_rig

PLATE = Plate(0.3, 0.2, 0.002, Material("aluminium", E=70e9, rho=2700.0, nu=0.33))


def era(name: str, x: float, y: float, stiffness: float = 17e3, bolt_mass: float = 0.0) -> Era:
    """An ERA at x, y [m]."""
    return Era(name, x, y, stiffness, damping=1.0, bolt_mass=bolt_mass, stroke=1e-4)


CORNERS = [era("SW", 0, 0), era("SE", 0.3, 0), era("NE", 0.3, 0.2), era("NW", 0, 0.2)]


@pytest.mark.parametrize(
    ("loads", "slower"), [([], 1.0), ([PointLoad(0.15, 0.1, mass=PLATE.mass)], math.sqrt(2))]
)
def test_rigid_body_frequencies_are_those_of_the_textbook(
    loads: list[PointLoad], slower: float
) -> None:
    """Heave sqrt(4k/m); each tilt of four corner springs sqrt(12 k/m).

    A mass of the plate's own at its centre slows the heave alone, by sqrt(2).
    """
    heave = math.sqrt(4 * 17e3 / PLATE.mass) / (2 * math.pi)
    expected = [heave / slower, math.sqrt(3) * heave, math.sqrt(3) * heave]
    found = rigid_body_frequencies(PLATE, CORNERS, loads=loads)
    assert found == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize(
    "eras",
    [
        [],
        CORNERS[:1],
        CORNERS[:2],
        [era("a", 0, 0), era("b", 0.15, 0.1), era("c", 0.3, 0.2)],  # in one line
        [era("a", 0, 0), era("b", 0.15, 0.1001), era("c", 0.3, 0.2)],  # nearly so
        [replace(each, stiffness=0.1) for each in CORNERS],
    ],
)
def test_plate_is_not_supported_when_a_rigid_body_mode_is_free(eras: list[Era]) -> None:
    """Fewer than three springs, all in one line, or too soft."""
    assert support_problem(PLATE, eras) is not None
    with pytest.raises(InputError, match=r"supported.*; put"):
        check_supported(PLATE, eras)


@pytest.mark.parametrize(
    ("eras", "loads"),
    [(CORNERS, []), (CORNERS[:3], []), (CORNERS[:2], [PointLoad(0.15, 0.2, 17e3)])],
)
def test_plate_is_supported_by_three_springs_not_in_line(
    eras: list[Era], loads: list[PointLoad]
) -> None:
    """Corner ERAs hold heave and both tilts; springs of loads count as those of ERAs do."""
    assert support_problem(PLATE, eras, loads=loads) is None


def test_point_load_at_an_era_acts_as_bolt_mass_and_parallel_spring():
    """A mass and a damper laid on an ERA act as its own would, but are not driven by its base."""
    plate = Plate(LENGTH, WIDTH, 0.0015, ALUMINIUM)
    free = solve_free_plate(plate, Mesh(12, 9, LENGTH, WIDTH))
    places = [(0.0, 0.0), (LENGTH, 0.0), (0.1, WIDTH)]
    eras = [Era(f"E{n}", x, y, 17000.0, 2.0, 0.0, 1e-4) for n, (x, y) in enumerate(places)]
    heavier = [Era(e.name, e.x, e.y, 17000.0, 2.0, 0.01, 1e-4) for e in eras]
    masses = [PointLoad(x, y, mass=0.01) for x, y in places]
    frequencies = np.array([60.0, 110.0, 400.0])
    np.testing.assert_allclose(
        free.acceleration(eras, frequencies, free.mesh.nodes, loads=masses),
        free.acceleration(heavier, frequencies, free.mesh.nodes),
        rtol=1e-8,
    )
    # The base of an ERA with spring k + s and stroke a k / (k + s) pushes as one of k and a does.
    springs = [PointLoad(x, y, stiffness=3000.0, damping=0.3) for x, y in places]
    stiffer = [Era(e.name, e.x, e.y, 20000.0, 2.3, 0.0, 1e-4) for e in eras]
    omega = 2 * np.pi * frequencies
    share = (17000 + 2j * omega) / (20000 + 2.3j * omega)
    np.testing.assert_allclose(
        free.acceleration(eras, frequencies, free.mesh.nodes, loads=springs),
        free.acceleration(stiffer, frequencies, free.mesh.nodes) * share[:, None, None],
        rtol=1e-8,
    )


HERTZ = np.array([60.0, 100.0, 250.0])


@pytest.mark.parametrize(
    ("fingertip", "hertz", "expected"),
    [
        (Fingertip(), HERTZ, [69, -87, -358]),
        (Fingertip(phalanx_mass=1e9), HERTZ, [972, 921, 507]),
        (Fingertip().scaled(2), np.zeros(1), [2000 * 500 / 2500]),
    ],
    ids=["phalanx that moves", "phalanx at rest", "twice the contact at rest"],
)
def test_dynamic_stiffness_of_a_fingertip(
    fingertip: Fingertip, hertz: FloatArray, expected: list[float]
) -> None:
    """Real parts as worked out from the formula by hand; scaled pulp and joint are in series."""
    found = fingertip.dynamic_stiffness(2 * np.pi * hertz)
    assert found.real == pytest.approx(expected, abs=1)
    assert (found.imag >= 2 * np.pi * hertz * (0.1 if fingertip.phalanx_mass < 1 else 1.999)).all()


LONG, WIDE, A = 0.3, 0.2, 0.01
# Moments of a disc of radius a about its centre, of its half and quarter beyond an edge or corner:
# mean of x - x0, and of (x - x0)². Half: 4 a / 3 pi and a² / 4.
CASES = {
    "inside": ((0.1, 0.08), (0.0, 0.0)),
    "edge": ((0.0, 0.08), (4 * A / (3 * math.pi), 0.0)),
    "corner": ((LONG, WIDE), (-4 * A / (3 * math.pi), -4 * A / (3 * math.pi))),
}


@pytest.mark.parametrize(("centre", "shift"), CASES.values(), ids=CASES)
def test_means_are_those_of_a_disc_by_hand(centre, shift):
    """Mean of x, y and of squares over what is on the plate of a disc."""
    x, y = centre

    def functions(points):
        dx, dy = points[:, 0] - x, points[:, 1] - y
        return np.column_stack([dx, dy, dx**2, dy**2])

    found = mean_over(functions, np.array([[x, y, A]]), length=LONG, width=WIDE)
    expected = [*shift, A**2 / 4, A**2 / 4]
    np.testing.assert_allclose(found[0], expected, rtol=1e-4, atol=1e-9)


def test_an_annular_wave_averages_to_the_bessel_function():
    """The mean of cos(k x) over a whole disc is 2 J1(k a) / (k a): 0.88010117 at k a = 1."""
    places = np.array([[0.1, 0.08, A], [0.2, 0.1, 0.0]])
    found = mean_over(lambda at: np.cos((at[:, :1] - 0.1) / A), places, length=LONG, width=WIDE)
    assert found[0, 0] == pytest.approx(0.88010117, rel=1e-6)
    assert found[1, 0] == pytest.approx(math.cos(0.1 / A))


@pytest.fixture(scope="module")
def on_feet():
    """The paper's rig on feet of 6 mm, with a mass on a disc."""
    rig = make_paper_rig(24, 18)
    eras = tuple(replace(era, foot=0.006) for era in rig.eras)
    return replace(rig, eras=eras, masses=(PointLoad(0.1, 0.1, mass=0.02, foot=0.01),))


def test_reduction_with_feet_equals_a_factor_for_each_frequency(on_feet):
    """Elements: the same consistent forces as the direct solution, within 1e-4."""
    frequencies = np.array([60.0, 150.0, 310.0])
    points = np.array([[0.05, 0.05], [0.2, 0.15]])
    arguments = (on_feet.eras, frequencies, points)
    free = solve_free_plate(on_feet.plate, on_feet.mesh, frequency_max=500.0)
    found = free.acceleration(*arguments, loads=on_feet.masses)
    respond = direct_responder(on_feet.plate, on_feet.mesh)
    exact = respond(*arguments, loads=on_feet.masses)
    np.testing.assert_allclose(found, exact, rtol=1e-3, atol=1e-4 * abs(exact).max())
