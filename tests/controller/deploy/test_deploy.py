"""The daemon as a service of the system: its files, as systemd itself judges them."""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from controller.deploy.files import service_files
from controller.deploy.needs import Needs, needs_of
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
