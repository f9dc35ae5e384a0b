"""The daemon as a service of the system: its files, as systemd itself judges them."""

import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from importlib.metadata import entry_points
from pathlib import Path

import pytest

from controller.deploy.files import service_files
from controller.deploy.needs import Needs, needs_of
from controller.main import run
from full_disk import full_disk
from model.errors import InputError

CONFIG, ERA = Path("/etc/era-haptics/daemon.yaml"), Path("/opt/era-haptics/bin/era")
MOST_EXPOSED = 2.0
"""On systemd's scale from 0 to 10; its words are `OK` up to 4.9 and `MEDIUM` from 5 on."""


def systemd_analyze(*arguments: str) -> "subprocess.CompletedProcess[str]":
    """Run it; without one the test is skipped, but fails where CI=true."""
    program = shutil.which("systemd-analyze")
    if program is None:
        reason = "systemd-analyze is not installed; on Debian: apt install systemd"
        if os.environ.get("CI") == "true":
            pytest.fail(reason)
        pytest.skip(reason)
    return subprocess.run([program, *arguments], capture_output=True, text=True, check=False)


def unit(folder: Path, needs: Needs) -> Path:
    """The unit in a file, with a command that is there, for systemd looks for it."""
    path = folder / "era-haptics.service"
    text = service_files(CONFIG, ERA, needs)[0].text
    path.write_text(text.replace(str(ERA), sys.executable), encoding="utf-8")
    return path


@pytest.mark.parametrize("needs", [Needs(), Needs(False, False, False, ("10.0.0.7",))])
def test_the_unit_is_in_order_and_hardened(tmp_path: Path, needs: Needs) -> None:
    """systemd understands every line of it, and finds it little exposed."""
    path = unit(tmp_path, needs)
    verified = systemd_analyze("verify", str(path))
    assert (verified.returncode, verified.stderr) == (0, "")
    judged = systemd_analyze("security", "--offline=true", "--json=short", str(path))
    assert json.loads(judged.stdout)
    overall = systemd_analyze("security", "--offline=true", "--no-pager", str(path)).stdout
    found = re.search(r"Overall exposure level for era-haptics.service: ([\d.]+)", overall)
    assert found is not None
    assert float(found[1]) <= MOST_EXPOSED


def test_less_is_allowed_where_less_is_needed(tmp_path: Path) -> None:
    """Without serial ports, panels and CAN none of them is allowed; networks by their addresses."""
    text = unit(tmp_path, Needs(False, False, False, ("10.0.0.7",))).read_text("utf-8")
    assert "IPAddressDeny=any\nIPAddressAllow=localhost 10.0.0.7\n" in text
    assert "AF_CAN" not in text
    assert re.findall(r"DeviceAllow=(.*)", text) == [""]
    everything = unit(tmp_path, Needs()).read_text("utf-8")
    assert "IPAddressAllow" not in everything
    assert "AF_CAN" in everything
    assert "char-ttyUSB rw" in re.findall(r"DeviceAllow=(.*)", everything)


@pytest.mark.parametrize(
    ("amplifiers", "touches", "expected"),
    [
        (["sim:///rig.yaml"], ["tuio:3333"], Needs(False, False, False, ())),
        (["serial:///dev/ttyUSB0"], ["evdev:/dev/input/event5"], Needs(True, True, False, ())),
        (["modbus+tcp://10.0.0.7:502/1"], [], Needs(False, False, False, ("10.0.0.7",))),
        (["modbus+tcp://[::1]:502/1"], ["tuio:[::1]:3333"], Needs(False, False, False, ())),
        (["modbus+tcp://amp.local:502/1"], [], Needs(False, False, False, None)),
        (["can+socketcan://can0#5"], ["tuio:0.0.0.0:3333"], Needs(False, False, True, None)),
        (["mine://box"], [], Needs(True, True, True, None)),
        (["sim:///rig.yaml"], ["mine:panel"], Needs(True, True, True, None)),
    ],
)
def test_needs(amplifiers: list[str], touches: list[str], expected: Needs) -> None:
    """What is allowed follows from the URLs; what a plug-in needs nobody knows."""
    assert needs_of(amplifiers, touches) == expected


@pytest.mark.parametrize("path", [Path("daemon.yaml"), Path("/home/me/my file.yaml"), Path("/a%n")])
def test_paths_that_a_unit_cannot_name(path: Path) -> None:
    """Relative ones and those with blanks or specifiers are refused, not quoted in the hope."""
    with pytest.raises(InputError, match="absolute paths of plain letters"):
        service_files(path, ERA, Needs())


def test_dry_run_writes_nothing(tmp_path: Path) -> None:
    """It prints the three files and what to do next; with a root it writes just these."""
    era = Path(sys.executable).with_name("era")
    command = [str(era), "systemd", "install"]
    shown = subprocess.run([*command, "--dry-run"], capture_output=True, text=True, check=True)
    for file in service_files(CONFIG, era, Needs()):
        assert str(file.path) in shown.stdout
        assert file.text in shown.stdout
    assert "systemctl enable --now era-haptics" in shown.stdout
    assert not any(file.path.exists() for file in service_files(CONFIG, era, Needs()))
    subprocess.run([*command, "--root", str(tmp_path)], capture_output=True, check=True)
    written = {f"/{path.relative_to(tmp_path)}" for path in tmp_path.rglob("*") if path.is_file()}
    assert written == {str(file.path) for file in service_files(CONFIG, era, Needs())}


@pytest.fixture
def era(capsys: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, str, str]]:
    """A command line in this process: its exit status, and what it printed."""

    def call(*arguments: str | Path) -> tuple[int, str, str]:
        group = entry_points(group="era_haptics.commands")
        status = run([str(argument) for argument in arguments], group)
        return (status, *capsys.readouterr())

    return call


def files(folder: Path) -> dict[str, bytes]:
    """All that lies in a folder."""
    return {str(path): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("before", [{}, {"systemd/system/era-haptics.service": "old\n"}])
def test_on_a_full_disk_nothing_is_installed(
    era: Callable[..., tuple[int, str, str]], before: dict[str, str], tmp_path: Path
) -> None:
    """One sentence; what was there stays, and neither of the smaller files comes alone."""
    for name, text in before.items():
        path = tmp_path / "etc" / name
        path.parent.mkdir(parents=True)
        path.write_text(text, encoding="utf-8")
    was_there = files(tmp_path)
    with full_disk():  # the unit is longer than that, the other two are shorter
        status, out, said = era("systemd", "install", "--root", tmp_path)
    unit_file = tmp_path / "etc/systemd/system/era-haptics.service"
    told = f"era: error: {unit_file}: there is no room left; make some, or write elsewhere"
    assert (status, out, said.splitlines()[-1:]) == (2, "", [told])
    assert files(tmp_path) == was_there


def test_what_cannot_be_written_last_leaves_the_first_as_it_was(
    era: Callable[..., tuple[int, str, str]], tmp_path: Path
) -> None:
    """A folder stands where the rules should: it is the one that is named, and no unit is there."""
    rules = tmp_path / "etc/udev/rules.d/70-era-haptics.rules"
    rules.mkdir(parents=True)
    status, out, said = era("systemd", "install", "--root", tmp_path)
    assert (status, out) == (2, "")
    assert f"era: error: {rules}: is a folder" in said
    assert files(tmp_path) == {}


def test_without_the_right_to_write_there_it_says_how(
    era: Callable[..., tuple[int, str, str]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What the system's folders are to everybody but root, and root is who runs tests in images."""

    def forbidden(path: Path, **options: bool) -> None:
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr(Path, "mkdir", forbidden)
    status, out, said = era("systemd", "install", "--root", tmp_path)
    assert (status, out) == (2, "")
    assert f"{tmp_path}/etc/systemd/system: you may not write this; run it with sudo" in said
