"""From a modal test in time on the simulated plate, through a file, to a new rig: the commands."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from examples.make_measured import record_responses, scanning_grid
from model.calibration.responses_file import write_responses_csv, write_responses_uff
from model.calibration.sensed_plate import sensed_plate
from model.cli import app
from model.errors import InputError
from model.rig.file import example_rig_path, load_rig
from model.rig.rig import Rig
from perturbed_plate import FREQUENCIES, perturbed
from sim.plant.accelerometer import Accelerometer

pytestmark = pytest.mark.usefixtures("plain_pictures")

MESH = "16x12"
SENSOR = Accelerometer("", 0, 0, noise_density=5e-3, reach=200.0, resolution=1e-3)


@pytest.fixture(scope="module")
def rig() -> Rig:
    """The paper's plate as its file has it."""
    return load_rig(example_rig_path(), mesh=MESH)


@pytest.fixture(scope="module")
def measured(rig: Rig, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with what twelve sensors recorded of the true plate, P3 wrong and P8 dead."""
    scales = {"P3": 0.8, "P8": 0.0}
    sensors = [
        replace(sensor, scale=scales.get(sensor.name, 1.0))
        for sensor in scanning_grid(rig.plate, 4, 3, like=SENSOR)
    ]
    responses = record_responses(perturbed(rig), sensors, FREQUENCIES)
    folder = tmp_path_factory.mktemp("measured")
    write_responses_uff(folder / "measured.uff", responses, rig)
    write_responses_csv(folder / "measured.csv", responses, rig)
    return folder


def run(*arguments: object) -> tuple[int, str]:
    """`era calibrate`: exit status and what it says."""
    result = CliRunner().invoke(app, ["calibrate", *map(str, arguments)])
    if isinstance(result.exception, InputError):
        return 2, str(result.exception)
    return result.exit_code, result.output


def test_bench_measurement_agrees_with_the_model(rig: Rig) -> None:
    """Stepped sine in time with silent sensors against the steady state in frequency.

    What differs is the structural damping, viscous in time: half a percent in the median.
    """
    truth = perturbed(rig)
    sensors = scanning_grid(rig.plate, 3, 2, like=Accelerometer("", 0, 0))
    frequencies = FREQUENCIES[:-1:4] + 0.37  # no whole number of periods between two of them
    found = record_responses(truth, sensors, frequencies)
    gains = np.column_stack([era.gain(frequencies) for era in truth.eras])
    exact = sensed_plate(truth, found.points, frequencies).responses()
    exact *= gains[:, :, None]
    wrong = np.linalg.norm(found.values - exact, axis=2) / np.linalg.norm(exact, axis=2)
    assert np.median(wrong) < 0.005
    assert wrong.max() < 0.03


def test_calibration_finds_the_true_parameters(rig: Rig, measured: Path, tmp_path: Path) -> None:
    """Every parameter within 2 %, faults of the measurement named, and a rig that can be used."""
    new = tmp_path / "new.yaml"
    status, said = run(
        example_rig_path(), measured / "measured.csv", "-o", new, "--mesh", MESH, "--json"
    )
    assert status == 0
    told = json.loads(said)
    truth = perturbed(rig)
    wanted = [truth.plate.material.E, truth.plate.loss_factor]
    wanted += [v for era in truth.eras for v in (era.stiffness, era.damping, era.bolt_mass)]
    np.testing.assert_allclose([row["after"] for row in told["parameters"]], wanted, rtol=0.02)
    assert told["dead_sensors"] == ["P8"]
    assert told["sensor_scales"]["P3"]["scale"] == pytest.approx(0.8, rel=0.01)
    assert told["held_out"]["error_after"] < 0.03 < 0.3 < told["held_out"]["error_before"]
    assert told["files"] == [str(new)]
    back = load_rig(new, mesh=MESH)
    gains = np.column_stack([era.gain(FREQUENCIES) for era in back.eras])
    true_gains = np.column_stack([era.gain(FREQUENCIES) for era in truth.eras])
    assert np.median(np.abs(gains / true_gains - 1)) < 0.01


def test_calibrate_refuses_a_rig_of_another_size(measured: Path, tmp_path: Path) -> None:
    """Measured on the paper's plate, asked of a longer one: refused, and no file is written."""
    other, new = tmp_path / "other.yaml", tmp_path / "new.yaml"
    other.write_text(example_rig_path().read_text().replace("12 in", "16 in"))
    status, said = run(other, measured / "measured.uff", "-o", new, "--mesh", MESH)
    assert status == 2
    assert re.search(r"SE\b.*\(0\.4064, 0\).*\(0\.3048, 0\)", said)
    assert not new.exists()
