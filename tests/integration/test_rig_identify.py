"""`era rig identify` as typed, against simulated amplifiers on wires in virtual time."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from typer.testing import Result

from model.rig.file import example_rig_path, load_rig
from model.rig.rig import Rig
from rig_files import write_rig
from typed_on_wire import PORT, typed_on_wire

Identify = Callable[..., Result]


@pytest.fixture
def truth() -> Rig:
    """The plate on the table: of the example's file, thinner, on one softer spring."""
    rig = load_rig(example_rig_path())
    first, *others = rig.eras
    eras = (replace(first, stiffness=0.88 * first.stiffness), *others)
    return replace(rig, plate=replace(rig.plate, thickness=0.985 * rig.plate.thickness), eras=eras)


@pytest.fixture
def identify(truth: Rig, monkeypatch: pytest.MonkeyPatch) -> Identify:
    """The command, on an event loop in virtual time with the far end in it."""

    def run(rig: Path, *options: str) -> Result:
        return typed_on_wire(monkeypatch, truth, "identify", str(rig), *options)

    return run


def test_rig_is_written_with_the_plate_that_is_there(
    tmp_path: Path, truth: Rig, identify: Identify
) -> None:
    """The spring that is softer, with less uncertainty, in a file that reads back; keys of JSON.

    Named by a daemon's file.
    """
    rig, new = write_rig(tmp_path / "rig.yaml", mesh="auto"), tmp_path / "rig2.yaml"
    daemon = tmp_path / "daemon.yaml"
    daemon.write_text("rig: rig.yaml\nsocket: d.sock\n")
    result = identify(daemon, "--url", PORT, "-o", str(new), "--yes", "--quick", "--json")
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
    assert found.uncertainty.stiffness < load_rig(rig).uncertainty.stiffness / 3
    written = {key: told["uncertainty"][key] for key in ("stiffness", "field", "common_gain")}
    assert written == pytest.approx(
        {key: getattr(found.uncertainty, key) for key in written}, rel=1e-4
    )
    assert "identified in place" in new.read_text("utf-8")


def test_plate_that_is_not_explained_is_refused_and_nothing_written(
    tmp_path: Path, identify: Identify, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Exit status 1, nothing promised, and what was at the output stays."""
    rig, new = write_rig(tmp_path / "rig.yaml", mesh="auto"), tmp_path / "rig2.yaml"
    new.write_text(before := "# Fitted by `era rig identify`:\n")
    monkeypatch.setattr("model.identification.identify.MAX_CHI2", 1e-3)
    result = identify(rig, "--url", PORT, "-o", str(new), "--yes", "--quick", "--json")
    told = json.loads(result.stdout)
    assert result.exit_code == 1
    assert (told["explained"], told["expected_contrast"], told["files"]) == (False, [], [])
    assert new.read_text() == before
