"""Conformance of the firmware on every wire: on this machine, and on the board in QEMU.

All at once, since they mostly wait. While an emulator waits for a processor it stands still, which
is no fault of the firmware: the suite measures that, and repeats the check.
"""

import contextlib
import json
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

OUT = Path(__file__).parents[2] / "out" / "firmware"
ERA = Path(sys.executable).parent / "era"
BOARD = ("qemu-system-arm", "-M", "mps2-an385", "-display", "none", "-monitor", "none", "-kernel")
CAN_NODE = "?heartbeat=1000#1"  # an emulator may be late by more than heartbeats of 50 ms allow
UARTS = ("serial", "modbus+rtu", None, "can+slcan")
QEMU_LOOKS = 1.5  # s; it looks once a second whether a host has opened its pseudo-terminals


def check_everywhere() -> bool:
    """Print a line for each wire; return whether each is of class A with no check failed."""
    with contextlib.ExitStack() as stack:
        places = stack.enter_context(on_this_machine())
        if shutil.which(BOARD[0]) and (OUT / "mps2-amplifier.elf").exists():
            places |= stack.enter_context(on_the_board())
        runs = {name: start(*place) for name, place in places.items()}
        results = {name: json.loads(run.communicate()[0]) for name, run in runs.items()}
        for name, result in results.items():
            show(name, result)
    return all(one["class"] == "A" and not one["failed"] for one in results.values())


def start(url: str, process: int) -> "subprocess.Popen[bytes]":
    """Start the suite on an amplifier in a process."""
    command = [ERA, "amp", "conformance", url, "--write", "--json", "--process", str(process)]
    return subprocess.Popen(command, stdout=subprocess.PIPE)


def show(name: str, result: dict[str, object]) -> None:
    """Print a result: its counts, and each check that failed."""
    counts = (f"{result[kind]} {kind}" for kind in ("passed", "failed", "skipped", "inconclusive"))
    print(f"  {name}: class {result['class']}, {', '.join(counts)}", flush=True)
    for check in result["checks"]:  # type: ignore[attr-defined]
        if check["result"] == "failed":
            print(f"    {check['name']}: {check['reason']}")


@contextlib.contextmanager
def on_this_machine() -> Iterator[dict[str, tuple[str, int]]]:
    """The program with each wire in a process of its own; yields URLs and processes."""
    urls = {}
    with contextlib.ExitStack() as stack:
        for options in (["--serial"], ["--modbus-rtu"], ["--modbus-tcp", "0"], ["--slcan"]):
            run = [OUT / "era-firmware", "--until-eof", *options]
            process = stack.enter_context(
                subprocess.Popen(run, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
            )
            assert process.stdout is not None
            assert process.stdin is not None
            stack.callback(process.stdin.close)
            url = process.stdout.readline().strip().replace("#1", CAN_NODE)
            urls[f"{options[0].strip('-')}, this machine"] = (url, process.pid)
        yield urls


@contextlib.contextmanager
def on_the_board() -> Iterator[dict[str, tuple[str, int]]]:
    """The board with each wire in an emulator of its own; yields URLs and processes."""
    urls = {}
    with contextlib.ExitStack() as stack:
        for number, scheme in enumerate(UARTS):
            if scheme is None:
                continue
            uarts = ["-serial", "null"] * number + ["-serial", "pty"]
            process = stack.enter_context(
                subprocess.Popen(
                    [*BOARD, OUT / "mps2-amplifier.elf", *uarts],
                    stdout=subprocess.PIPE,
                    stderr=subprocess.DEVNULL,
                    text=True,
                )
            )
            stack.callback(process.terminate)
            assert process.stdout is not None
            (path,) = re.findall(r"/dev/\S+", process.stdout.readline())
            stack.enter_context(Path(path).open("r+b", buffering=0))  # held open for QEMU
            fragment = CAN_NODE if scheme == "can+slcan" else ""
            urls[f"{scheme}, board in QEMU"] = (f"{scheme}://{path}{fragment}", process.pid)
        time.sleep(QEMU_LOOKS)
        yield urls


if __name__ == "__main__":
    sys.exit(not check_everywhere())
