"""Conformance of the firmware on every wire: on this machine, and on the board in QEMU.

    python firmware/test/conformance.py [--board]

--board: on the board alone. Twice as many at once as there are processors, since they mostly wait.
While an emulator waits for a processor it stands still, which is no fault of the firmware: the
suite measures that, repeats the check, and calls it inconclusive if that does not end.
"""

import contextlib
import json
import os
import shutil
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from sim.firmware.programs import ending_with_parent

OUT = Path(__file__).parents[2] / "out" / "firmware"
ERA = Path(sys.executable).parent / "era"
BOARD = ("qemu-system-arm", "-M", "mps2-an385", "-display", "none", "-monitor", "none", "-kernel")
CAN_NODE = "?heartbeat=10000#1"  # the clock of an emulator is slow while it waits
AT_ONCE = 2 * (os.cpu_count() or 1)

Place = Callable[[], AbstractContextManager[tuple[str, int]]]
"""Makes an amplifier for as long as a context lasts: its URL, and the number of its process."""


@dataclass(frozen=True)
class Run:
    """A finished suite: the exit status, the report as JSON if there is one, and messages."""

    status: int
    report: str
    messages: str

    def show(self, name: str) -> bool:
        """Print a line, and one for each check that did not pass; return whether it counts.

        So it does if the class is A, no check failed, and most of them passed.
        """
        if not self.report:
            print(f"  {name}: no report, exit status {self.status}: {self.messages}", flush=True)
            return False
        result = json.loads(self.report)
        kinds = ("passed", "failed", "skipped", "inconclusive")
        counts = ", ".join(f"{result[kind]} {kind}" for kind in kinds)
        print(f"  {name}: class {result['class']}, {counts}, {result['seconds']:.0f} s", flush=True)
        for check in result["checks"]:
            if check["result"] in ("failed", "inconclusive"):
                print(f"    {check['result']}: {check['name']}: {check['reason']}")
        is_seen = result["passed"] > result["inconclusive"] + result["not_run"]
        return bool(result["class"] == "A" and not result["failed"] and is_seen)


def check_everywhere(*, on_board_alone: bool = False) -> bool:
    """Print the result on each wire; return whether all of them count."""
    places = on_the_board() | ({} if on_board_alone else on_this_machine())
    with ThreadPoolExecutor(AT_ONCE) as pool:
        runs = {name: pool.submit(run_at, place) for name, place in places.items()}
        passed = [run.result().show(name) for name, run in runs.items()]
    return all(passed)


def run_at(place: Place) -> Run:
    """Run the suite on an amplifier."""
    with place() as (url, process):
        command = [ERA, "amp", "conformance", url, "--write", "--json", "--process", str(process)]
        done = subprocess.run(
            ending_with_parent(command), capture_output=True, text=True, check=False
        )
    return Run(done.returncode, done.stdout, done.stderr.strip())


def on_this_machine() -> dict[str, Place]:
    """The program with each wire in a process of its own."""
    wires = ("--serial", "--modbus-rtu", "--modbus-tcp", "--slcan")
    return {f"{wire.strip('-')}, this machine": partial(program, wire) for wire in wires}


def on_the_board() -> dict[str, Place]:
    """The board with each wire in an emulator of its own; none where QEMU is not installed."""
    if not shutil.which(BOARD[0]) or not (OUT / "mps2-amplifier.elf").exists():
        return {}
    uarts = {"serial": 0, "modbus+rtu": 1, "can+slcan": 3}
    return {
        f"{scheme}, board in QEMU": partial(emulator, scheme, uart)
        for scheme, uart in uarts.items()
    }


@contextlib.contextmanager
def program(wire: str) -> Iterator[tuple[str, int]]:
    """The firmware as a program, until its input is closed; wire: its option."""
    options = [wire, "0"] if wire == "--modbus-tcp" else [wire]
    with subprocess.Popen(
        [OUT / "era-firmware", "--until-eof", *options],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as process:
        assert process.stdout is not None
        yield process.stdout.readline().strip().replace("#1", CAN_NODE), process.pid


@contextlib.contextmanager
def emulator(scheme: str, uart: int) -> Iterator[tuple[str, int]]:
    """The board, with a wire at one of its UARTs over TCP.

    Bytes of a pseudo-terminal are passed on by a thread of the kernel, which beside other load
    keeps them for up to some 100 ms, and not as a wait of the emulator.
    """
    with contextlib.ExitStack() as stack:
        with socket.create_server(("127.0.0.1", 0)) as listening:
            line = f"socket,id=line,fd={listening.fileno()},server=on,wait=off,nodelay=on"
            options = ("-chardev", line, *["-serial", "null"] * uart, "-serial", "chardev:line")
            process = started(stack, *options, keeps=(listening.fileno(),))
            url = f"{scheme}://127.0.0.1:{listening.getsockname()[1]}"
        yield url + (CAN_NODE if scheme == "can+slcan" else ""), process.pid


def started(
    stack: contextlib.ExitStack, *options: str, keeps: tuple[int, ...] = ()
) -> "subprocess.Popen[str]":
    """Start an emulator until the stack ends; keeps: descriptors that it inherits."""
    command = ending_with_parent([*BOARD, OUT / "mps2-amplifier.elf", *options])
    pipe, null = subprocess.PIPE, subprocess.DEVNULL
    process = subprocess.Popen(command, stdout=pipe, stderr=null, text=True, pass_fds=keeps)
    stack.enter_context(process)
    stack.callback(process.terminate)
    return process


if __name__ == "__main__":
    sys.exit(not check_everywhere(on_board_alone="--board" in sys.argv[1:]))
