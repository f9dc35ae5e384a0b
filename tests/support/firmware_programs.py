"""The firmware, built by the compiler of this machine, and its programs."""

import re
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

FIRMWARE = Path(__file__).parents[2] / "firmware"


def build_firmware(folder: Path) -> Path:
    """Build the programs for this machine into a folder; return it."""
    subprocess.run(["make", "-s", "-C", FIRMWARE, f"OUT={folder}"], check=True)
    return folder


@contextmanager
def running_firmware(folder: Path, *options: str) -> Iterator[str]:
    """Run the amplifier with an option for its line; yield the URL of that line."""
    with subprocess.Popen(
        [folder / "era-firmware", "--until-eof", *options],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        yield process.stdout.readline().strip()
        process.stdin.close()


MACHINE = ("qemu-system-arm", "-M", "mps2-an385", "-display", "none", "-monitor", "none")
"""QEMU's board with a Cortex-M3."""

UARTS = {"serial": 0, "modbus+rtu": 1, "can+slcan": 3}
"""Number of the UART of each scheme."""


@contextmanager
def running_machine(folder: Path, scheme: str) -> Iterator[str]:
    """Run the amplifier in QEMU, with a UART on a pseudo-terminal; yield its URL."""
    uarts = ["-serial", "null"] * UARTS[scheme] + ["-serial", "pty"]
    with subprocess.Popen(
        [*MACHINE, "-kernel", folder / "mps2-amplifier.elf", *uarts],
        stdout=subprocess.PIPE,
        text=True,
    ) as process:
        assert process.stdout is not None
        (path,) = re.findall(r"/dev/\S+", process.stdout.readline())
        yield f"{scheme}://{path}" + ("#1" if scheme == "can+slcan" else "")
        process.terminate()
