"""Identification of hidden thin plates in Hermite elements, whose theory is not the model's."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.identification.hidden import Hidden, draw
from long_form import shortly
from model.identification.forward import Sensor
from model.identification.least_squares import Measurement
from model.identification.stages import (
    FittedModel,
    Setting,
    chi2,
    fit_in_stages,
    solved_with_modes_of,
)
from model.reduction.free_plate import solve_free_plate
from model.rig.rig_file import example_rig_path, load_rig

FREQUENCIES = np.linspace(40.0, 500.0, 27)


def identified(hidden: Hidden, *, rounds: int = 4) -> FittedModel:
    """The paper's rig fitted to a hidden plate; each ERA plays as many in four tones."""
    rig = load_rig(example_rig_path())
    sensors = [Sensor(era.name, era.name) for era in rig.eras]
    values = hidden.measured(FREQUENCIES, np.random.default_rng(1))
    played = (np.arange(len(FREQUENCIES))[:, None] + np.arange(4)) % 4 < rounds
    values = np.where(played[:, None], values, np.nan)
    free = solve_free_plate(rig.plate, rig.mesh, frequency_max=500.0)
    measurement = Measurement.of(sensors, FREQUENCIES, values)
    return fit_in_stages(Setting(rig, free, measurement))


@pytest.mark.parametrize("seed", shortly([1, 2], [1]))
def test_hidden_mass_and_places_are_found(seed: int) -> None:
    """A mass of 3 g is found within 5 % and 2 mm, places within 0.5 mm, springs within 2 %."""
    hidden = draw("form", seed)
    found = identified(hidden)
    assert chi2(found) < 1.3
    values = found.problem.model.at(found.best.x).values
    ((x, y, mass),) = hidden.mounted.masses
    assert values.masses[0, 0] == pytest.approx(mass, rel=0.05)
    np.testing.assert_allclose(values.masses[0, 1:], [x, y], atol=2e-3)
    np.testing.assert_allclose(values.places, hidden.mounted.at, atol=5e-4)
    np.testing.assert_allclose(values.stiffness, hidden.mounted.stiffness, rtol=0.02)


def test_one_round_of_interleaved_tones_finds_the_springs() -> None:
    """Where each ERA plays every fourth tone only, springs are found within 2 %, and no mass."""
    hidden = draw("plain", 4)
    found = identified(hidden, rounds=1)
    assert chi2(found) < 1.4
    values = found.problem.model.at(found.best.x).values
    np.testing.assert_allclose(values.stiffness, hidden.mounted.stiffness, rtol=0.02)
    assert values.masses[0, 0] < 0.3e-3


def test_plate_solved_anew_keeps_the_modes_of_the_fit() -> None:
    """One a tenth thicker, with tones to 180 Hz, has its eighth mode above twice that."""
    rig = load_rig(example_rig_path())
    free = solve_free_plate(rig.plate, rig.mesh, frequency_max=180.0)
    measurement = Measurement.of(
        [Sensor("A1", rig.eras[0].name)], np.array([60.0]), np.ones((1, 1, 4))
    )
    model = Setting(rig, free, measurement).model(masses=0)
    thicker = rig.plate.scaled(modulus=1.0, thickness=1.1)
    anew = replace(model, free=solved_with_modes_of(free, thicker))
    shifts = np.zeros(model.space.size)
    shifts[model.space.groups["mode_shifts"]] = 0.01
    assert anew.at(shifts).responses.shape == (1, 1, len(rig.eras))
    # Eigenvalues go as the square of the thickness, but for its shear.
    lowest = [np.sort(each.free.modes.eigenvalues)[3:11] for each in (model, anew)]
    np.testing.assert_allclose(lowest[1], 1.21 * lowest[0], rtol=2e-3)
