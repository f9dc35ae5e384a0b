"""`era rig check` against far ends that are processes on real wires, with a known fault each.

The rig is the same each time; what is wrong is in the file that the far end simulates. Time is
virtual there, since the findings do not depend on it.
"""

import asyncio
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from controller.cli.demo import app
from drivers.errors import LinkError
from far_end_process import far_end_process
from model.calibration.responses_file import write_responses_csv, write_responses_uff
from model.errors import InputError
from model.rig.file import load_rig
from rig_files import TWO_AMPLIFIERS, write_rig
from sim.sensors.accelerometer import Accelerometer, scanning_grid
from sim.sensors.stepped_sine import record_responses

QUICK = ("--frequencies", "61:461:80", "--settle", "0.5", "--listen", "0.1", "--grid", "3x3")
MESH = "12x9"


async def check(rig: Path, *options: str) -> tuple[int, dict[str, Any]]:
    """Exit status and what the command says."""
    arguments = ["rig", "check", str(rig), *QUICK, "--json", *options]
    # In a thread, for the command has an event loop of its own.
    result = await asyncio.to_thread(CliRunner().invoke, app, arguments)
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result.exit_code, json.loads(result.stdout)


SWAPPED = (
    ("amplifier: main, channel: 0", "amplifier: main, channel: 9"),
    ("amplifier: main, channel: 3", "amplifier: main, channel: 0"),
    ("amplifier: main, channel: 9", "amplifier: main, channel: 3"),
)
DEAD = (
    (
        "stroke: 100 um, amplifier: main, channel: 1",
        "stroke: 100 um, gains: [[100, 0.001, 0]], amplifier: main, channel: 1",
    ),
)
INVERTED = (
    (
        "stroke: 100 um, amplifier: main, channel: 2",
        "stroke: 100 um, gains: [[100, 1, 180]], amplifier: main, channel: 2",
    ),
)
THICKER = (("thickness: 1.5 mm", "thickness: 2 mm"),)


@pytest.mark.parametrize(
    ("changes", "wire", "says"),
    [
        ((), "modbus-rtu", ["WIRING WELL"]),
        (
            SWAPPED,
            "modbus-tcp",
            ["SWAPPED: channel 0 of amplifier main (ERA SW in the rig) drives "],
        ),
        pytest.param(
            DEAD,
            "socketcand",
            ["DEAD: channel 1 of amplifier main (ERA SE in the rig)"],
            marks=pytest.mark.long,
        ),
        (INVERTED, "serial", ["INVERTED: channel 2 of amplifier main (ERA NE in the rig)"]),
        pytest.param(
            THICKER,
            "serial",
            ["PLATE: the rig does not match", "  plate.thickness "],
            marks=pytest.mark.long,
        ),
    ],
)
async def test_each_fault_is_detected_and_named(
    tmp_path: Path, changes: tuple[tuple[str, str], ...], wire: str, says: list[str]
) -> None:
    """By what the sensors say, through real amplifiers, guard and wire, whichever wire it is."""
    rig = write_rig(tmp_path / "rig.yaml", mesh=MESH)
    truth = write_rig(tmp_path / "truth.yaml", *changes, mesh=MESH)
    async with far_end_process(truth, "--virtual-time", "--wire", f"main={wire}") as far_end:
        status, told = await check(
            rig, "--sensors", str(far_end.control), "--url", f"main={far_end.urls['main']}"
        )
        state = await far_end.ask("state")
    assert status == (1 if changes else 0)
    assert told["all_well"] is (not changes)
    findings = [row for row in told["findings"] if not row.startswith("  correct ")]
    for row, start in zip(findings, says, strict=False):
        assert row.startswith(start)
    assert len([row for row in findings if not row.startswith("  ")]) == 1
    assert state["amplifiers"]["main"]["state"] == "SWITCH_ON_DISABLED"
    assert set(state["amplifiers"]["main"]["levels"]) == {0.0}


async def test_plugs_exchanged_between_two_amplifiers_on_two_wires(tmp_path: Path) -> None:
    """A channel of one amplifier drives an ERA of the other's: both are named, by amplifier."""
    rig = write_rig(tmp_path / "rig.yaml", *TWO_AMPLIFIERS, mesh=MESH)
    truth = write_rig(
        tmp_path / "truth.yaml",
        *TWO_AMPLIFIERS,
        ("amplifier: main, channel: 1", "amplifier: main, channel: 9"),
        ("amplifier: side, channel: 0", "amplifier: main, channel: 1"),
        ("amplifier: main, channel: 9", "amplifier: side, channel: 0"),
        mesh=MESH,
    )
    wires = ("--wire", "main=serial", "--wire", "side=modbus-tcp")
    async with far_end_process(truth, "--virtual-time", *wires, amplifiers=2) as far_end:
        options = [o for name, url in far_end.urls.items() for o in ("--url", f"{name}={url}")]
        status, told = await check(rig, "--sensors", str(far_end.control), *options)
    assert status == 1
    assert told["swapped"] == [["SE", "NE"]]
    assert told["plate"]["matches"]
    by_era = {row["era"]: (row["amplifier"], row["channel"]) for row in told["channels"]}
    assert (by_era["SE"], by_era["NE"]) == (("main", 1), ("side", 0))


@pytest.mark.parametrize("ending", ["csv", "uff"])
def test_responses_of_a_real_plate_are_read_from_a_file(tmp_path: Path, ending: str) -> None:
    """Measured by a modal test in time, two plugs exchanged: the file's names are the rig's own."""
    rig = load_rig(write_rig(tmp_path / "rig.yaml", mesh=MESH))
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


async def test_rig_check_reports_skipped_checks(tmp_path: Path) -> None:
    """No sensors, both kinds, no listener, levels and frequencies out of range."""
    rig = write_rig(tmp_path / "rig.yaml", mesh=MESH)
    unserved = ("--sensors", str(tmp_path / "no"))
    for kind, words, options in (
        (InputError, "--measured", ()),
        (InputError, "--measured", (*unserved, "--measured", "x.csv")),
        (LinkError, "--sensors|--measured", unserved),
        (InputError, "--level", (*unserved, "--level", "0.5")),
        (InputError, "limits.frequency", (*unserved, "--frequencies", "10,20")),
        (InputError, "got side=x", (*unserved, "--url", "side=x")),
        (InputError, "x.csv", ("--measured", "x.csv")),
    ):
        with pytest.raises(kind, match=words):
            await check(rig, *options)
