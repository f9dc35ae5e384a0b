"""A plate that is simulated in place of a desk, against the plate in time and its own seed."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from controller.cli.main import run
from era_haptics.lab.measuring import measure
from era_haptics.lab.measuring.sound_card import Desk
from examples.make_measured import record_responses
from model.calibration.responses import WiredSensor, read_measured, responses_of
from model.rig.rig import Uncertainty
from model.rig.rig_file import example_rig_path, load_rig
from model.structure.attachments import PointLoad
from sim.plant.fingers import Accelerometer

PLACES = ((0.03, 0.05), (0.20, 0.11))
FIXED = tuple(WiredSensor(f"P{n}", x, y, n, 1e-3) for n, (x, y) in enumerate(PLACES, start=1))
MOVED = tuple(replace(each, input=1, mass=20e-3) for each in FIXED)
FREQUENCIES = np.array([61.0, 151.0, 311.0])


@pytest.mark.parametrize("sensors", [FIXED, MOVED], ids=["fixed", "moved"])
def test_responses_are_those_of_the_plate_in_time(sensors, monkeypatch, tmp_path) -> None:
    """Of a plate that is the rig's, without noise; a sensor of 20 g weighs where it is moved to."""
    monkeypatch.setattr(measure, "NOISE", 0.0)
    rig = replace(load_rig(example_rig_path()), uncertainty=Uncertainty.none())
    output = tmp_path / "measured.csv"
    measure.measured_by_simulation(Desk(rig, sensors), output, frequencies=FREQUENCIES, seed=0)
    found = responses_of(read_measured(output), rig)
    for number, each in enumerate(sensors):
        load = PointLoad(each.x, each.y, mass=each.mass)
        loaded = replace(rig, masses=(*rig.masses, load) if each.mass else rig.masses)
        in_time = record_responses(loaded, [Accelerometer("", each.x, each.y)], FREQUENCIES)
        error = found.values[:, :, number] - in_time.values[:, :, 0]
        assert np.abs(error).max() < 0.03 * np.abs(in_time.values).max()


def test_one_command_measures_a_plate_that_deviates_as_its_seed_draws_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The same for the same seed, another one for another; it says where to calibrate to."""
    sensors = tmp_path / "sensors.csv"
    sensors.write_text("sensor,x_m,y_m,input,mv_per_m_s2\nP1,0.03,0.05,1,10\nP2,0.2,0.11,2,10\n")
    rig = example_rig_path()
    found = []
    for seed in ("0", "0", "1"):
        output = tmp_path / f"{len(found)}.csv"
        options = ["--simulated", "--sensors", str(sensors), "-o", str(output), "--seed", seed]
        status = run(["measure", str(rig), *options, "--frequencies", "61:301:40"])
        assert status == 0
        assert f"-o {tmp_path / 'calibrated.yaml'}" in capsys.readouterr().out
        found.append(responses_of(read_measured(output), load_rig(rig)).values)
    np.testing.assert_array_equal(found[0], found[1])
    assert np.abs(found[2] / found[0] - 1).max() > 0.05


@pytest.mark.parametrize("option", [("--device", "jack"), ("--stepped",), ("--y-cable",)])
def test_what_only_a_sound_card_does_is_refused(option: tuple[str, ...], tmp_path: Path) -> None:
    """Exit status 2, and nothing is written."""
    sensors, output = tmp_path / "sensors.csv", tmp_path / "measured.csv"
    sensors.write_text("sensor,x_m,y_m,input,mv_per_m_s2\nP1,0.03,0.05,1,10\n")
    arguments = ["measure", str(example_rig_path()), "--simulated", "--sensors", str(sensors)]
    assert run([*arguments, "-o", str(output), *option]) == 2
    assert not output.exists()
