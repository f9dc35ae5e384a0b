"""`era rig check --url` and `identify` as typed, beside a plate on a wire in virtual time."""

import asyncio
import json
import math
from collections.abc import Callable, Coroutine
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from controller.cli.commands import app
from controller.process.daemon_process import SocketLock
from drivers.errors import CommandError, LinkError
from examples.make_measured import record_responses, scanning_grid
from model.calibration.responses import write_responses_csv, write_responses_uff
from model.errors import InputError
from model.rig.rig import Rig
from model.rig.rig_file import example_rig_path, load_rig
from model.structure.plate import SCALED
from plates import write_rig
from real_wires import WIRES, far_side
from sim.amplifier.simulated_amplifier import Amplifier
from sim.plant.fingers import Accelerometer
from virtual_lines import run_virtual

Typed = Callable[..., Result]
PORT = "serial:///dev/memory0?baud=921600"
"""Where the line is."""


@pytest.fixture
def typed(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Typed:
    """A command of `era rig` for the example's file, on this plate; raises the command's error."""
    write_rig(tmp_path / "rig.yaml", mesh="auto")

    def run(command: str, *options: str, on: Rig, file: str = "rig.yaml") -> Result:
        async def beside(main: Coroutine[Any, Any, Any]) -> Any:
            async with far_side(WIRES["serial"], on):
                return await main

        monkeypatch.setattr(asyncio, "run", lambda main: run_virtual(beside(main)))
        result = CliRunner().invoke(app, ["rig", command, str(tmp_path / file), *options])
        if result.exception is not None and not isinstance(result.exception, SystemExit):
            raise result.exception
        return result

    return run


@pytest.fixture
def plate() -> Rig:
    """The plate of the example's file."""
    return load_rig(example_rig_path())


def test_plate_of_the_file_is_well(typed: Typed, plate: Rig) -> None:
    """By four sensors at its ERAs; keys of the check and of the measurement."""
    result = typed("check", "--url", PORT, "--yes", "--json", on=plate)
    told = json.loads(result.stdout)
    assert result.exit_code == 0
    assert told["wiring_matches"]
    assert told["plate"]["matches"]
    assert [each["era"] for each in told["sensors"]] == ["SW", "SE", "NE", "NW"]
    assert told["responses"] == 28 * 4 * 4
    assert told["measure_time_s"] < 40


def _weak(rig: Rig, factor: float) -> Rig:
    first, *others = rig.eras
    return replace(rig, eras=(replace(first, stroke=factor * first.stroke), *others))


def _inverted(rig: Rig) -> Rig:
    first, *others = rig.eras
    return replace(rig, eras=(replace(first, gains=((100.0, 1.0, math.pi),)), *others))


def _exchanged(rig: Rig) -> Rig:
    wiring = {**rig.wiring} | {"SW": rig.wiring["SE"], "SE": rig.wiring["SW"]}
    return replace(rig, wiring=wiring)


def _thinner(rig: Rig) -> Rig:
    return replace(rig, plate=replace(rig.plate, thickness=0.9 * rig.plate.thickness))


@pytest.mark.parametrize(
    ("spoil", "verdicts", "plate_matches"),
    [
        (lambda rig: _weak(rig, 1e-6), ["dead", "well", "well", "well"], True),
        (lambda rig: _weak(rig, 0.5), ["weak", "well", "well", "well"], True),
        (_inverted, ["inverted", "well", "well", "well"], True),
        (_thinner, ["well"] * 4, True),  # as far as sheets tell of its modulus
        (_exchanged, ["well"] * 4, False),  # its sensors go with an ERA: another plate
    ],
    ids=["dead", "weak", "inverted", "thinner", "exchanged"],
)
def test_faults_of_wiring_and_plate_are_told(
    typed: Typed,
    plate: Rig,
    spoil: Callable[[Rig], Rig],
    verdicts: list[str],
    plate_matches: bool,
) -> None:
    """Exit status 1, and the verdict of each channel; a thinner plate by the promises it misses.

    Its modulus stands for the square of its thickness.
    """
    result = typed("check", "--url", PORT, "--yes", "--json", on=spoil(plate))
    told = json.loads(result.stdout)
    assert result.exit_code == 1
    assert [each["states"] for each in told["channels"]] == [[verdict] for verdict in verdicts]
    assert told["wiring_matches"] == (verdicts == ["well"] * 4)
    assert told["plate"]["matches"] == plate_matches
    if spoil is _thinner:
        assert told["plate"]["changes"]["modulus"] == pytest.approx(0.9**2 - 1, abs=0.03)
        assert told["plate"]["kept_share"] < 0.5


def test_daemon_that_runs_keeps_its_amplifiers(typed: Typed, plate: Rig, tmp_path: Path) -> None:
    """Its file names the rig; refused while it holds its socket."""
    (tmp_path / "daemon.yaml").write_text("rig: rig.yaml\nsocket: d.sock\n")
    lock = SocketLock(tmp_path / "d.sock")
    try:
        with pytest.raises(InputError, match="daemon is running"):
            typed("check", "--url", PORT, "--yes", on=plate, file="daemon.yaml")
    finally:
        lock.release()
    assert typed("check", "--url", PORT, "--yes", on=plate, file="daemon.yaml").exit_code == 0


def test_amplifier_that_is_not_there_or_has_no_sensors_is_named(
    typed: Typed, plate: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By its port or its name, before anything plays."""
    with pytest.raises(LinkError, match="/dev/nowhere"):
        typed("check", "--url", "serial:///dev/nowhere?baud=921600", "--yes", on=plate)
    monkeypatch.setattr(Amplifier, "attach", lambda amplifier, sensing: None)
    with pytest.raises(CommandError, match=r"main.*sensors"):
        typed("check", "--url", PORT, "--yes", on=plate)


def test_plate_that_changes_while_it_is_measured_is_refused(
    typed: Typed, plate: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first tones, played last again, differ."""
    monkeypatch.setattr("model.identification.least_squares.DRIFTED", 1e-9)
    with pytest.raises(InputError, match="at the end"):
        typed("check", "--url", PORT, "--yes", on=plate)


@pytest.fixture
def truth() -> Rig:
    """The plate on the table: of the example's file, thinner, on one softer spring."""
    rig = load_rig(example_rig_path())
    first, *others = rig.eras
    eras = (replace(first, stiffness=0.88 * first.stiffness), *others)
    return replace(rig, plate=replace(rig.plate, thickness=0.985 * rig.plate.thickness), eras=eras)


def test_rig_is_written_with_the_plate_that_is_there(
    tmp_path: Path, truth: Rig, typed: Typed
) -> None:
    """The spring that is softer, with less uncertainty, in a file that reads back; keys of JSON.

    Named by a daemon's file.
    """
    new = tmp_path / "rig2.yaml"
    (tmp_path / "daemon.yaml").write_text("rig: rig.yaml\nsocket: d.sock\n")
    options = ("--url", PORT, "-o", str(new), "--yes", "--quick", "--json")
    result = typed("identify", *options, on=truth, file="daemon.yaml")
    told = json.loads(result.stdout)
    assert result.exit_code == 0
    assert told["explained"]
    assert told["files"] == [str(new)]
    assert told["measure_time_s"] < 10
    assert [each["era"] for each in told["sensors"]] == ["SW", "SE", "NE", "NW"]
    (spring,) = (each for each in told["parameters"] if each["name"] == "stiffness SW")
    assert abs(spring["difference"] + 12) < 3 * spring["standard_error"] < 6
    for each in told["expected_contrast"]:
        assert each["before_db"] < each["after_db"]
    found = load_rig(new)
    assert found.eras[0].stiffness == pytest.approx(truth.eras[0].stiffness, rel=0.03)
    assert found.uncertainty.stiffness < load_rig(tmp_path / "rig.yaml").uncertainty.stiffness / 3
    written = {key: told["uncertainty"][key] for key in ("stiffness", "field", "common_gain")}
    assert written == pytest.approx(
        {key: getattr(found.uncertainty, key) for key in written}, rel=1e-4
    )
    assert "identified in place" in new.read_text("utf-8")


def test_plate_that_is_not_explained_is_refused_and_nothing_written(
    tmp_path: Path, truth: Rig, typed: Typed, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Exit status 1, nothing promised, and what was at the output stays."""
    new = tmp_path / "rig2.yaml"
    new.write_text(before := "# Fitted by `era rig identify`:\n")
    monkeypatch.setattr("model.identification.identify.MAX_CHI2", 1e-3)
    options = ("--url", PORT, "-o", str(new), "--yes", "--quick", "--json")
    result = typed("identify", *options, on=truth)
    told = json.loads(result.stdout)
    assert result.exit_code == 1
    assert (told["explained"], told["expected_contrast"], told["files"]) == (False, [], [])
    assert new.read_text() == before


@pytest.mark.parametrize("command", [["check"], ["identify", "-o", "rig2.yaml"]])
def test_plate_with_a_part_that_does_not_scale_is_refused_before_it_is_measured(
    tmp_path: Path, typed: Typed, plate: Rig, monkeypatch: pytest.MonkeyPatch, command: list[str]
) -> None:
    """Before a port is opened, where none is; also of a known thickness, which would not help."""
    monkeypatch.delitem(SCALED, "loss_exponent")
    known = "uncertainty: {thickness: 0}\nplate:\n  loss_exponent: 0.2\n"
    write_rig(tmp_path / "rig.yaml", ("plate:\n", known), mesh="auto")
    with pytest.raises(InputError, match=r"^plate\.loss_exponent: (?!.*set unc).*era rig identify"):
        typed(*command, "--url", "serial:///dev/none", "--yes", on=plate)


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
