"""`era rig check` of responses in a file."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from controller.cli.commands import app
from examples.make_measured import record_responses, scanning_grid
from model.calibration.responses_file import write_responses_csv, write_responses_uff
from model.rig.file import load_rig
from rig_files import write_rig
from sim.plant.accelerometer import Accelerometer


@pytest.mark.parametrize("ending", ["csv", "uff"])
def test_responses_of_a_real_plate_are_read_from_a_file(tmp_path: Path, ending: str) -> None:
    """Measured by a modal test in time, two plugs exchanged: the file's names are the rig's own."""
    rig = load_rig(write_rig(tmp_path / "rig.yaml", mesh="12x9"))
    sensors = scanning_grid(rig.plate, 3, 2, like=Accelerometer("", 0, 0, noise_density=5e-3))
    responses = record_responses(rig, sensors, np.linspace(61, 461, 6))
    swapped = replace(responses, values=responses.values[:, [0, 3, 2, 1]])
    file = tmp_path / f"measured.{ending}"
    write = write_responses_csv if ending == "csv" else write_responses_uff
    write(file, swapped, rig)
    result = CliRunner().invoke(
        app, ["rig", "check", str(tmp_path / "rig.yaml"), "--measured", str(file)]
    )
    assert result.exit_code == 1
    assert "SWAPPED: channel 1 of amplifier main (ERA SE in the rig) drives ERA NW" in result.stdout
    assert "PLATE" not in result.stdout
    assert "INVERTED" not in result.stdout
