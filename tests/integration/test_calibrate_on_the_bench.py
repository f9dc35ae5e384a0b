"""From a modal test in time on the simulated plate, through a file, to a new rig: the commands."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from examples.make_measured import record_responses, scanning_grid
from model.calibration.responses import write_responses_csv
from model.cli import app
from model.rig.rig import Rig
from model.rig.rig_file import example_rig_path, load_rig
from plates import PERTURBED_PLATE_FREQUENCIES, perturbed
from sim.plant.fingers import Accelerometer

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
    responses = record_responses(perturbed(rig), sensors, PERTURBED_PLATE_FREQUENCIES)
    folder = tmp_path_factory.mktemp("measured")
    write_responses_csv(folder / "measured.csv", responses, rig)
    return folder


def test_calibration_finds_the_true_parameters(rig: Rig, measured: Path, tmp_path: Path) -> None:
    """Every parameter within 2 %, faults of the measurement named, and a rig that can be used."""
    new = tmp_path / "new.yaml"
    files = (example_rig_path(), measured / "measured.csv", "-o", new)
    result = CliRunner().invoke(app, ["calibrate", *map(str, files), "--mesh", MESH, "--json"])
    assert result.exit_code == 0, result.output
    told = json.loads(result.stdout)
    truth = perturbed(rig)
    wanted = [truth.plate.material.E, truth.plate.loss_factor]
    wanted += [v for era in truth.eras for v in (era.stiffness, era.damping, era.bolt_mass)]
    np.testing.assert_allclose([row["after"] for row in told["parameters"]], wanted, rtol=0.02)
    assert told["dead_sensors"] == ["P8"]
    assert told["sensor_scales"]["P3"]["scale"] == pytest.approx(0.8, rel=0.01)
    assert told["held_out"]["error_after"] < 0.03 < 0.3 < told["held_out"]["error_before"]
    assert told["files"] == [str(new)]
    back = load_rig(new, mesh=MESH)
    gains = np.column_stack([era.gain(PERTURBED_PLATE_FREQUENCIES) for era in back.eras])
    true_gains = np.column_stack([era.gain(PERTURBED_PLATE_FREQUENCIES) for era in truth.eras])
    assert np.median(np.abs(gains / true_gains - 1)) < 0.01
