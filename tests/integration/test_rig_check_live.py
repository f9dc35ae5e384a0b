"""`era rig check --url` as typed, against simulated amplifiers on wires in virtual time."""

import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from typer.testing import Result

from controller.daemon.socket_lock import SocketLock
from drivers.errors import CommandError, LinkError
from model.errors import InputError
from model.rig.file import example_rig_path, load_rig
from model.rig.rig import Rig
from rig_files import write_rig
from sim.amplifier.contract import Amplifier
from typed_on_wire import PORT, typed_on_wire

Check = Callable[..., Result]


@pytest.fixture
def check(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Check:
    """The command, on an event loop in virtual time with a plate of its own at the far end."""

    def run(*options: str, on: Rig, file: str = "rig.yaml") -> Result:
        write_rig(tmp_path / "rig.yaml", mesh="auto")
        return typed_on_wire(monkeypatch, on, "check", str(tmp_path / file), *options)

    return run


@pytest.fixture
def plate() -> Rig:
    """The plate of the example's file."""
    return load_rig(example_rig_path())


def test_plate_of_the_file_is_well(check: Check, plate: Rig) -> None:
    """By four sensors at its ERAs; keys of the check and of the measurement."""
    result = check("--url", PORT, "--yes", "--json", on=plate)
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
        (_thinner, ["well"] * 4, False),
        (_exchanged, ["well"] * 4, False),  # its sensors go with an ERA: another plate
    ],
    ids=["dead", "weak", "inverted", "thinner", "exchanged"],
)
def test_faults_of_wiring_and_plate_are_told(
    check: Check,
    plate: Rig,
    spoil: Callable[[Rig], Rig],
    verdicts: list[str],
    plate_matches: bool,
) -> None:
    """Exit status 1, and the verdict of each channel; a thinner plate by its thickness."""
    result = check("--url", PORT, "--yes", "--json", on=spoil(plate))
    told = json.loads(result.stdout)
    assert result.exit_code == 1
    assert [each["states"] for each in told["channels"]] == [[verdict] for verdict in verdicts]
    assert told["wiring_matches"] == (verdicts == ["well"] * 4)
    assert told["plate"]["matches"] == plate_matches
    if spoil is _thinner:
        likeliest = told["plate"]["explanations"][0]
        assert likeliest["key"] == "plate.thickness"
        assert likeliest["found"] == pytest.approx(0.9 * plate.plate.thickness, rel=0.02)


def test_daemon_that_runs_keeps_its_amplifiers(check: Check, plate: Rig, tmp_path: Path) -> None:
    """Its file names the rig; refused while it holds its socket."""
    (tmp_path / "daemon.yaml").write_text("rig: rig.yaml\nsocket: d.sock\n")
    lock = SocketLock(tmp_path / "d.sock")
    try:
        with pytest.raises(InputError, match="daemon is running"):
            check("--url", PORT, "--yes", on=plate, file="daemon.yaml")
    finally:
        lock.release()
    assert check("--url", PORT, "--yes", on=plate, file="daemon.yaml").exit_code == 0


def test_amplifier_that_is_not_there_or_has_no_sensors_is_named(
    check: Check, plate: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By its port or its name, before anything plays."""
    with pytest.raises(LinkError, match="/dev/nowhere"):
        check("--url", "serial:///dev/nowhere?baud=921600", "--yes", on=plate)
    monkeypatch.setattr(Amplifier, "attach", lambda amplifier, sensing: None)
    with pytest.raises(CommandError, match=r"main.*sensors"):
        check("--url", PORT, "--yes", on=plate)


def test_plate_that_changes_while_it_is_measured_is_refused(
    check: Check, plate: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first tones, played last again, differ."""
    monkeypatch.setattr("model.identification.measurement.DRIFTED", 1e-9)
    with pytest.raises(InputError, match="at the end"):
        check("--url", PORT, "--yes", on=plate)
