"""Full conformance of the firmware on bare metal, in QEMU: `make qemu-test`.

Starts `make -C firmware qemu`, whose serial line is a TCP port and whose Modbus RTU line is a
pseudo-terminal, and runs `era amp conformance --write` on both. A run without a verdict, because
the machine was too slow, is repeated twice. Tests use `emulated_board` for the same process.
"""

import os
import re
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[2]
ERA = str(Path(sys.executable).with_name("era"))
PROGRAMS = ("arm-none-eabi-gcc", "qemu-system-arm", "make")
TERMINAL = re.compile(r"redirected to (/dev/\S+) \(label serial1\)")
NO_VERDICT = 3
RUNS = 3
BAUD = 230400
"""The host allows for the transmission time of such a line: QEMU delivers bytes late."""


class Board(NamedTuple):
    """URLs of an emulated board."""

    serial: str
    rtu: str


@contextmanager
def emulated_board(folder: Path, *options: str) -> Iterator[Board]:
    """Build the firmware into a folder, run it in QEMU, and yield its URLs; options: for make."""
    make = ["make", "-s", "-C", str(ROOT / "firmware"), f"OUT={folder}", *options]
    subprocess.run([*make, "bare-metal"], check=True)
    port = free_port()
    command = [*make, "qemu", f"PORT={port}"]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, text=True, start_new_session=True
    ) as process:
        try:
            terminal = terminal_of(process)
            serial = f"serial+tcp://127.0.0.1:{port}?baud={BAUD}"
            yield Board(serial, f"modbus+rtu://{terminal}#1")
        finally:
            os.killpg(process.pid, signal.SIGKILL)  # make and QEMU


def terminal_of(process: subprocess.Popen[str]) -> str:
    """Return the pseudo-terminal of the Modbus line, which QEMU prints."""
    lines = []
    for line in process.stdout:
        lines.append(line)
        match = TERMINAL.search(line)
        if match:
            return match[1]
    raise RuntimeError("QEMU did not start:\n" + "".join(lines))


def free_port() -> int:
    """Return a TCP port that is free now."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        port: int = server.getsockname()[1]
    return port


def passes_conformance(url: str) -> bool:
    """Run all checks on a line until every check has a verdict."""
    command = [ERA, "amp", "conformance", url, "--write"]
    for _ in range(RUNS):
        sys.stdout.write(f"$ era amp conformance {url} --write\n")
        sys.stdout.flush()
        status = subprocess.run(command, check=False).returncode
        if status != NO_VERDICT:
            return status == 0
    return False


def main() -> None:
    """Check both lines; exit 1 if one fails."""
    with emulated_board(ROOT / "out" / "firmware") as board:
        results = [passes_conformance(url) for url in board]
    sys.exit(not all(results))


if __name__ == "__main__":
    main()
