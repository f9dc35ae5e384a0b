"""The service's unit and its drop-in, checked by systemd itself."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

import model
from installed_program import installed_program

FOLDER = Path(model.__file__).parents[1] / "examples" / "systemd"
MAX_EXPOSURE = 2.0
"""On systemd's scale from 0 to 10, where `OK` ends at 4.9."""


@pytest.mark.parametrize("is_allowed", [False, True])
def test_unit_is_valid_and_hardened(tmp_path: Path, is_allowed: bool) -> None:
    """systemd accepts every line and rates the exposure as low, devices allowed or not."""
    program = installed_program("systemd-analyze", package="systemd")
    text = (FOLDER / "era-haptics.service").read_text("utf-8")
    if is_allowed:
        drop_in = (FOLDER / "devices.conf").read_text("utf-8")
        commented = re.findall(r"^#(\w+=.*\n)", drop_in, re.MULTILINE)
        assert {"DeviceAllow=char-ttyUSB rw\n", "DeviceAllow=char-input r\n"} < set(commented)
        text = text.replace("[Install]", f"{''.join(commented)}[Install]")
    unit = tmp_path / "era-haptics.service"
    unit.write_text(text.replace("/opt/era-haptics/bin/era", sys.executable), encoding="utf-8")
    verified = subprocess.run([program, "verify", unit], capture_output=True, text=True)
    assert (verified.returncode, verified.stderr) == (0, "")
    judged = subprocess.run(
        [program, "security", "--offline=true", "--no-pager", unit], capture_output=True, text=True
    )
    found = re.search(r"Overall exposure level for era-haptics.service: ([\d.]+)", judged.stdout)
    assert found is not None
    assert float(found[1]) <= MAX_EXPOSURE
