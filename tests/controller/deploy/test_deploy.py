"""Files of the system service, checked by systemd itself."""

import json
import re
import subprocess
import sys
from collections.abc import Callable
from importlib.metadata import entry_points
from pathlib import Path

import pytest

from controller.cli.main import run
from controller.deploy.files import service_files
from controller.deploy.permissions import Permissions, required_permissions
from full_disk import full_disk
from installed_program import installed_program
from model.errors import InputError

UNIT = Path("/etc/systemd/system/era-haptics.service")
CONFIG, ERA = Path("/etc/era-haptics/daemon.yaml"), Path("/opt/era-haptics/bin/era")
MAX_EXPOSURE = 2.0
"""On systemd's scale from 0 to 10, where `OK` ends at 4.9."""


def systemd_analyze(*arguments: str) -> "subprocess.CompletedProcess[str]":
    """Run systemd-analyze; skip the test without it, fail it under CI=true."""
    program = installed_program("systemd-analyze", package="systemd")
    return subprocess.run([program, *arguments], capture_output=True, text=True, check=False)


def unit(folder: Path, permissions: Permissions) -> Path:
    """Write the unit with an existing command, since systemd checks for it."""
    path = folder / "era-haptics.service"
    text = service_files(CONFIG, ERA, permissions)[UNIT]
    path.write_text(text.replace(str(ERA), sys.executable), encoding="utf-8")
    return path


@pytest.mark.parametrize(
    "permissions", [Permissions(), Permissions(False, False, False, ("10.0.0.7",))]
)
def test_unit_is_valid_and_hardened(tmp_path: Path, permissions: Permissions) -> None:
    """systemd-analyze accepts every line and rates its exposure as low."""
    path = unit(tmp_path, permissions)
    verified = systemd_analyze("verify", str(path))
    assert (verified.returncode, verified.stderr) == (0, "")
    judged = systemd_analyze("security", "--offline=true", "--json=short", str(path))
    assert json.loads(judged.stdout)
    overall = systemd_analyze("security", "--offline=true", "--no-pager", str(path)).stdout
    found = re.search(r"Overall exposure level for era-haptics.service: ([\d.]+)", overall)
    assert found is not None
    assert float(found[1]) <= MAX_EXPOSURE


def test_unit_allows_only_what_is_needed(tmp_path: Path) -> None:
    """Without serial ports, panels and CAN the unit allows only the addresses given."""
    text = unit(tmp_path, Permissions(False, False, False, ("10.0.0.7",))).read_text("utf-8")
    assert "IPAddressDeny=any\nIPAddressAllow=localhost 10.0.0.7\n" in text
    assert "AF_CAN" not in text
    assert re.findall(r"DeviceAllow=(.*)", text) == [""]
    everything = unit(tmp_path, Permissions()).read_text("utf-8")
    assert "IPAddressAllow" not in everything
    assert "AF_CAN" in everything
    assert "char-ttyUSB rw" in re.findall(r"DeviceAllow=(.*)", everything)
    rules = Path("/etc/udev/rules.d/70-era-haptics.rules")
    assert "SUBSYSTEM" not in service_files(CONFIG, ERA, Permissions(False, False, False))[rules]
    assert service_files(CONFIG, ERA, Permissions())[rules].count("GROUP=") == 2


@pytest.mark.parametrize(
    ("amplifiers", "touches", "expected"),
    [
        (["sim:///rig.yaml"], ["tuio:3333"], Permissions(False, False, False, ())),
        (
            ["serial:///dev/ttyUSB0"],
            ["evdev:/dev/input/event5"],
            Permissions(True, True, False, ()),
        ),
        (["modbus+tcp://10.0.0.7:502/1"], [], Permissions(False, False, False, ("10.0.0.7",))),
        (["modbus+tcp://[::1]:502/1"], ["tuio:[::1]:3333"], Permissions(False, False, False, ())),
        (["modbus+tcp://amp.local:502/1"], [], Permissions(False, False, False, None)),
        (["can+socketcan://can0#5"], ["tuio:0.0.0.0:3333"], Permissions(False, False, True, None)),
        (["mine://box"], [], Permissions(True, True, True, None)),
        (["sim:///rig.yaml"], ["mine:panel"], Permissions(True, True, True, None)),
    ],
)
def test_required_permissions(
    amplifiers: list[str], touches: list[str], expected: Permissions
) -> None:
    """Permissions follow from the URLs; a plug-in's scheme gets all of them."""
    assert required_permissions(amplifiers, touches) == expected


@pytest.mark.parametrize("path", [Path("daemon.yaml"), Path("/home/me/my file.yaml"), Path("/a%n")])
def test_service_files_refuse_path_when_systemd_would_interpret_it(path: Path) -> None:
    """Relative paths and those with blanks or specifiers are refused."""
    with pytest.raises(InputError, match=re.escape(str(path))):
        service_files(path, ERA, Permissions())


@pytest.fixture
def era(capsys: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, str, str]]:
    """Run a command line in this process; return exit status, stdout and stderr."""

    def call(*arguments: str | Path) -> tuple[int, str, str]:
        group = entry_points(group="era_haptics.commands")
        status = run([str(argument) for argument in arguments], group)
        return (status, *capsys.readouterr())

    return call


def contents(folder: Path) -> dict[str, bytes]:
    """The files of a folder by path."""
    return {str(path): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_install_prints_files_when_dry_run(
    era: Callable[..., tuple[int, str, str]], tmp_path: Path
) -> None:
    """A dry run prints the files and the next commands; with a root these are written."""
    status, out, _ = era("systemd", "install", "--dry-run")
    files = service_files(CONFIG, Path(sys.executable).with_name("era"), Permissions())
    assert status == 0
    assert all(str(path) in out and text in out for path, text in files.items())
    assert "systemctl enable --now era-haptics" in out
    assert not any(path.exists() for path in files)
    era("systemd", "install", "--root", tmp_path)
    assert contents(tmp_path).keys() == {f"{tmp_path}{path}" for path in files}


@pytest.mark.parametrize("before", [{}, {"systemd/system/era-haptics.service": "old\n"}])
def test_install_writes_nothing_when_disk_is_full(
    era: Callable[..., tuple[int, str, str]], before: dict[str, str], tmp_path: Path
) -> None:
    """One line names the unit; existing files stay, and no smaller file is written."""
    for name, text in before.items():
        path = tmp_path / "etc" / name
        path.parent.mkdir(parents=True)
        path.write_text(text, encoding="utf-8")
    was_there = contents(tmp_path)
    with full_disk():  # the unit is longer than that, the other two are shorter
        status, out, err = era("systemd", "install", "--root", tmp_path)
    assert (status, out) == (2, "")
    assert err.splitlines()[-1].startswith(f"era: error: {tmp_path / UNIT.relative_to('/')}: ")
    assert contents(tmp_path) == was_there


def test_install_writes_nothing_when_last_file_fails(
    era: Callable[..., tuple[int, str, str]], tmp_path: Path
) -> None:
    """A folder in place of the rules is named, and no unit is written."""
    rules = tmp_path / "etc/udev/rules.d/70-era-haptics.rules"
    rules.mkdir(parents=True)
    status, out, err = era("systemd", "install", "--root", tmp_path)
    assert (status, out) == (2, "")
    assert f"era: error: {rules}: " in err
    assert contents(tmp_path) == {}


def test_install_suggests_sudo_when_not_permitted(
    era: Callable[..., tuple[int, str, str]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Permission errors are injected, since tests in images run as root."""

    def forbidden(path: Path, **options: bool) -> None:
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr(Path, "mkdir", forbidden)
    status, out, err = era("systemd", "install", "--root", tmp_path)
    assert (status, out) == (2, "")
    assert f"{tmp_path}/etc/systemd/system: " in err
    assert "sudo" in err
