"""Units of systemd, checked by systemd itself."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from processes.installed import installed_program

ROOT = Path(__file__).parents[2]
UNITS = ROOT / "examples" / "systemd"


MAX_EXPOSURE = 2.0
"""On systemd's scale from 0 to 10, where `OK` ends at 4.9."""


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
