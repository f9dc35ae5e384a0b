"""Units of systemd, checked by systemd itself."""

import os
import re
import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import pytest
import yaml

from processes.installed import installed_program

ROOT = Path(__file__).parents[2]
UNITS = ROOT / "examples" / "systemd"
WEEKEND = ROOT / "examples" / "weekend"


AT_HOME = ("era-sound-server", "era-soft-amp", "era-plate")
"""In the order in which they start."""
MAX_EXPOSURE = 2.0
"""On systemd's scale from 0 to 10, where `OK` ends at 4.9."""
MAX_EXPOSURE_AT_HOME = 6.3
"""Without what needs privileges or namespaces of the manager: capabilities and views of files."""
REAL_TIME = (
    *("sched_setscheduler", "mlockall", "setpriority", "ioctl", "memfd_create"),
    *("timer_create", "timer_settime"),
)
"""What a sound server and its clients call."""


def exposure(program: str, unit: Path, *options: str) -> float:
    """What systemd rates a unit."""
    judged = subprocess.run(
        [program, "security", "--offline=true", "--no-pager", *options, unit],
        capture_output=True,
        text=True,
        env=os.environ | {"XDG_RUNTIME_DIR": str(unit.parent)},
    )
    match = re.search(rf"Overall exposure level for {unit.name}: ([\d.]+)", judged.stdout)
    assert match is not None, judged.stderr
    return float(match[1])


def allows(program: str, unit: str, call: str) -> bool:
    """Whether the filters of a unit leave a system call, by systemd's own sets."""
    is_allowed = False
    for is_denied, names in re.findall(r"^SystemCallFilter=(~?)(.*)$", unit, re.MULTILINE):
        calls = names.split()
        for name in calls:  # of sets within sets, too
            if name.startswith("@"):
                command = [program, "syscall-filter", "--no-pager", name]
                listed = subprocess.run(command, capture_output=True, text=True)
                within = {line.strip() for line in listed.stdout.splitlines()[1:]}
                calls += within - {*calls}
        if call in calls:
            is_allowed = not is_denied
    return is_allowed


@pytest.mark.parametrize("is_allowed", [False, True])
def test_unit_is_valid_and_hardened(tmp_path: Path, is_allowed: bool) -> None:
    """systemd accepts every line and rates the exposure as low, devices allowed or not."""
    program = installed_program("systemd-analyze", package="systemd")
    text = (UNITS / "era-haptics.service").read_text("utf-8")
    if is_allowed:
        drop_in = (UNITS / "devices.conf").read_text("utf-8")
        commented = re.findall(r"^#(\w+=.*\n)", drop_in, re.MULTILINE)
        assert {"DeviceAllow=char-ttyUSB rw\n", "DeviceAllow=char-input r\n"} < set(commented)
        text = text.replace("[Install]", f"{''.join(commented)}[Install]")
    unit = tmp_path / "era-haptics.service"
    unit.write_text(text.replace("/opt/era-haptics/bin/era", sys.executable), encoding="utf-8")
    verified = subprocess.run([program, "verify", unit], capture_output=True, text=True)
    assert (verified.returncode, verified.stderr) == (0, "")
    assert exposure(program, unit) <= MAX_EXPOSURE


def test_units_at_home_are_valid_and_start_one_after_the_other(tmp_path: Path) -> None:
    """systemd accepts them as a user's; each wants and follows the one before it.

    systemd restarts the amplifier, and kills it if it stalls. The link is that of the rig; the card
    has an output for each exciter, an input for the sensor and one for the cable.
    """
    program = installed_program("systemd-analyze", package="systemd")
    texts = {}
    for name in AT_HOME:
        texts[name] = (WEEKEND / f"{name}.service").read_text("utf-8")
        text = re.sub(r"ExecStart=\S+", f"ExecStart={sys.executable}", texts[name])
        text = text.replace("%h/era-haptics/.venv/bin/era", sys.executable)
        (tmp_path / f"{name}.service").write_text(text.replace("%h/plate", "/"), "utf-8")
    verified = subprocess.run(
        [program, "--user", "verify", *tmp_path.iterdir()],
        capture_output=True,
        text=True,
        env=os.environ | {"XDG_RUNTIME_DIR": str(tmp_path), "SYSTEMD_UNIT_PATH": f"{tmp_path}:"},
    )
    assert (verified.returncode, verified.stderr) == (0, "")
    for name in AT_HOME:
        assert exposure(program, tmp_path / f"{name}.service", "--user") <= MAX_EXPOSURE_AT_HOME
        if name != "era-plate":
            assert "RestrictRealtime" not in texts[name]
            assert "@resources" not in texts[name]
            for call in REAL_TIME:
                assert allows(program, texts[name], call), (name, call)
    for predecessor, name in pairwise(AT_HOME):
        for key in ("Wants", "After"):
            assert f"\n{key}={predecessor}.service\n" in texts[name]
    rig = yaml.safe_load((WEEKEND / "rig.yaml").read_text("utf-8"))
    (amplifier,) = rig["amplifiers"].values()
    (link,) = re.findall(r"--link (\S+)", texts["era-soft-amp"])
    assert amplifier["url"] == f"serial://{link}"
    outputs, inputs = map(int, re.findall(r"--(?:out|in)channels (\d+)", texts["era-sound-server"]))
    assert (outputs, inputs) == (len(rig["eras"]), 2)
    assert f"--channels {len(rig['eras'])} " in texts["era-soft-amp"]
    for line in ("Type=notify", "Restart=always", "WatchdogSec=500ms", "WatchdogSignal=SIGKILL"):
        assert f"\n{line}\n" in texts["era-soft-amp"]
