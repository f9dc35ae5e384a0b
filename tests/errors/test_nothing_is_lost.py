"""Commands that are interrupted, or whose disk is full, leave what was there as it was."""

import contextlib
import io
import os
import shlex
import signal
import subprocess
import sys
from collections.abc import Iterator
from importlib.metadata import entry_points
from pathlib import Path
from unittest.mock import patch

import pytest

from controller.main import run
from error_cases import RIG, filled
from full_disk import full_disk

WRITING = {
    "table build rig.yaml -o out.npz --frequencies 60:90:30 --grid 4x3": (
        "model.table.build.build_in_parts"
    ),
    "table export table.npz --format csv -o out.csv": "model.table.export.export_csv",
    "table export table.npz --format mat -o out.mat": "model.table.export.export_mat",
    "plate map rig.yaml --drive SW=110 -o out.png": "model.vibration.maps.plate_map",
    "calibrate rig.yaml measured.csv -o out.yaml": "model.calibration.calibrate.calibrate",
}
"""Commands that write a file, each with what takes long in it."""


@pytest.fixture(scope="module")
def shelf(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A table, and a measurement."""
    folder = tmp_path_factory.mktemp("shelf")
    with filled(folder):
        yield folder


@pytest.fixture
def home(shelf: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a rig and what is on the shelf."""
    rig = RIG.replace("[40, 300]", "[40, 500]")
    (tmp_path / "rig.yaml").write_text(rig, encoding="utf-8")
    for name in ("table.npz", "measured.csv"):
        (tmp_path / name).write_bytes((shelf / name).read_bytes())
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / ".cache"))
    return tmp_path


def files(folder: Path) -> dict[str, bytes]:
    """What lies in a folder."""
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}


def said_by(command: str) -> tuple[int, str]:
    """A command's exit status, and what it says on standard error."""
    err = io.StringIO()
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(err):
        status = run(shlex.split(command), entry_points(group="era_haptics.commands"))
    return status, err.getvalue()


@pytest.mark.parametrize("command", WRITING)
def test_interrupted_a_command_says_no_more_and_leaves_all_as_it_was(
    command: str, home: Path
) -> None:
    """130, no traceback, and the result that was there before is there still."""
    (home / command.split("-o ")[1].split()[0]).write_bytes(b"")
    before = files(home)
    with patch(WRITING[command], side_effect=KeyboardInterrupt):
        status, said = said_by(command)
    assert status == 130
    assert "Traceback" not in said
    assert files(home) == before


@pytest.mark.parametrize("command", WRITING)
def test_on_a_full_disk_the_result_of_before_stays(command: str, home: Path) -> None:
    """An error in a paragraph, and neither half a result nor the old one gone."""
    status, said = said_by(command)
    assert status == 0, said
    before = files(home)
    with full_disk():
        status, said = said_by(command)
    assert status == 2
    assert said.startswith("era: error: ")
    assert "Traceback" not in said
    assert files(home) == before


@pytest.mark.parametrize("command", ["sim rig.yaml --serial", "daemon daemon.yaml"])
def test_a_program_that_runs_ends_at_control_c(command: str, home: Path) -> None:
    """As a terminal does it, once it serves: that is how it is ended, so it is done, in order."""
    (home / "daemon.yaml").write_text("rig: rig.yaml\ntable: table.npz\nsocket: era.sock\n")
    (home / "rig.yaml").write_text(RIG, encoding="utf-8")
    era = Path(sys.executable).with_name("era")
    with subprocess.Popen(
        [era, *command.split()],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env={**os.environ, "PYTHONUNBUFFERED": "1"},
    ) as process:
        assert process.stdout is not None
        said = ""
        for line in process.stdout:
            said += line
            if "serial://" in line or "serving at" in line:
                break
        process.send_signal(signal.SIGINT)
        said += process.stdout.read()
        assert process.wait(20) == 0, said
    assert "Traceback" not in said
    assert not (home / "era.sock").exists()
