"""Full conformance of the firmware on bare metal, in QEMU: `make qemu-test`.

Starts `make -C firmware qemu`, whose serial line is a TCP port and whose Modbus RTU line is a
pseudo-terminal, and runs `era amp conformance --write` on both. Checks without a verdict, because
this machine or the emulator was late, are repeated. Tests use `emulated_board` too.
"""

import json
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
NO_VERDICT = "no verdict"
RUNS = 5
MAX_UNDECIDED = 0.1
"""Share of checks that can remain without a verdict after all runs."""
BAUD = 57600
"""The host allows for the transmission time of such a line: QEMU passes on 11 kB/s or more."""


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
    """Run all checks on a line, then again those without a verdict; print what remains.

    Fails if a check fails, or if too many checks have no verdict.
    """
    command = [ERA, "amp", "conformance", url, "--write", "--json"]
    selection: list[str] = []
    count = 0
    for _ in range(RUNS):
        sys.stdout.write(f"$ {' '.join(command[1:] + selection)}\n")
        sys.stdout.flush()
        completed = subprocess.run(
            [*command, *selection], check=False, capture_output=True, text=True
        )
        sys.stdout.write(completed.stderr)
        if not completed.stdout:
            return False
        checks = json.loads(completed.stdout)["checks"]
        count = max(count, len(checks))
        failed = [check for check in checks if check["result"] in ("failed", "not_run")]
        undecided = [check for check in checks if NO_VERDICT in check["reason"]]
        for check in [*failed, *undecided]:
            sys.stdout.write(f"{check['result']}  {check['name']}: {check['reason']}\n")
        if failed or not undecided:
            return not failed
        selection = ["-k", " or ".join(check["name"] for check in undecided)]
    return len(undecided) <= MAX_UNDECIDED * count


def main() -> None:
    """Check both lines; exit 1 if one fails."""
    with emulated_board(ROOT / "out" / "firmware") as board:
        results = [passes_conformance(url) for url in board]
    sys.exit(not all(results))


if __name__ == "__main__":
    main()
