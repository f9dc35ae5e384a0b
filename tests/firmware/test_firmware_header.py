"""The header of the firmware and the table of the protocol."""

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]


def test_header_is_that_of_the_table() -> None:
    """`docs/generators/firmware_header.py > firmware/core/protocol.h` was run since it changed."""
    generator = ROOT / "docs" / "generators" / "firmware_header.py"
    done = subprocess.run([sys.executable, generator], capture_output=True, text=True, check=True)
    assert (ROOT / "firmware" / "core" / "protocol.h").read_text("utf-8") == done.stdout
