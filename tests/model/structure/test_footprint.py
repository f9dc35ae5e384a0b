"""Footprints: means over discs, whole and cut by the plate's edges, and what they change."""

import math
from dataclasses import replace

import numpy as np
import pytest

from model.errors import InputError
from model.reduction.free_plate import solve_free_plate
from model.reduction.reduced_plate import reduce_plate
from model.structure.attachments import Era, PointLoad, footprints_of
from model.structure.footprint import mean_over
from model.transients.base_motion import Term
from model.vibration.natural_modes import direct_responder
from paper_plate import make_paper_rig
from sim.plant.plant import Plant

LENGTH, WIDTH, A = 0.3, 0.2, 0.01
# Moments of a disc of radius a about its centre, of its half and quarter beyond an edge or corner:
# mean of x - x0, and of (x - x0)². Half: 4 a / 3 pi and a² / 4.
CASES = {
    "inside": ((0.1, 0.08), (0.0, 0.0)),
    "edge": ((0.0, 0.08), (4 * A / (3 * math.pi), 0.0)),
    "corner": ((LENGTH, WIDTH), (-4 * A / (3 * math.pi), -4 * A / (3 * math.pi))),
}


@pytest.mark.parametrize(("centre", "shift"), CASES.values(), ids=CASES)
def test_means_are_those_of_a_disc_by_hand(centre, shift):
    """Mean of x, y and of squares over what is on the plate of a disc."""
    x, y = centre

    def functions(points):
        dx, dy = points[:, 0] - x, points[:, 1] - y
        return np.column_stack([dx, dy, dx**2, dy**2])

    found = mean_over(functions, np.array([[x, y, A]]), length=LENGTH, width=WIDTH)
    expected = [*shift, A**2 / 4, A**2 / 4]
    np.testing.assert_allclose(found[0], expected, rtol=1e-4, atol=1e-9)


def test_an_annular_wave_averages_to_the_bessel_function():
    """The mean of cos(k x) over a whole disc is 2 J1(k a) / (k a): 0.88010117 at k a = 1."""
    places = np.array([[0.1, 0.08, A], [0.2, 0.1, 0.0]])
    found = mean_over(lambda at: np.cos((at[:, :1] - 0.1) / A), places, length=LENGTH, width=WIDTH)
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


def test_plate_in_time_settles_to_the_response_on_feet(on_feet):
    """The plate in time under one ERA's tone reaches the steady response, within 1 %."""
    frequency = 130.0
    eras, loads = on_feet.eras, on_feet.masses
    point = np.array([[0.2, 0.15]])
    free = solve_free_plate(on_feet.plate, on_feet.mesh, frequency_max=500.0)
    expected = abs(free.acceleration(eras, np.array([frequency]), point, loads=loads)[0, 0, 0])
    reduced = reduce_plate(on_feet.plate, on_feet.mesh, footprints_of(eras, loads))
    plant = Plant(reduced, eras, loads=loads)
    found = _steady_amplitude(plant, reduced.at(point), eras[0], frequency)
    assert found == pytest.approx(expected, rel=0.01)


def _steady_amplitude(plant, shapes, era: Era, frequency: float) -> float:

    omega = 2 * math.pi * frequency
    plant.set_input(0, [Term(0.0, math.inf, omega, era.stroke)])
    plant.skip(3.0)
    _, values = plant.advance(3.1, sample_rate=20_000.0, shapes=shapes)
    return float(np.sqrt(2 * np.mean(values**2)))


@pytest.mark.parametrize("foot", [-1e-3, math.nan])
def test_a_foot_must_be_a_length(foot):
    """Negative and not a number are refused, of ERAs and loads."""
    with pytest.raises(InputError):
        PointLoad(0.1, 0.1, mass=0.1, foot=foot)
    with pytest.raises(InputError):
        replace(make_paper_rig(12, 9).eras[0], foot=foot)
