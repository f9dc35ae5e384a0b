"""Conformance of the firmware on every wire: on this machine, and on the board in QEMU.

All at once, since they mostly wait. A wire with a failed check is tried again, alone, up to twice:
beside other load an emulator stands still at times.
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
UARTS = ("serial", "modbus+rtu", None, "can+slcan")
TRIES_ALONE = 2
QEMU_LOOKS = 1.5  # s; it looks once a second whether a host has opened its pseudo-terminals


def check_everywhere() -> bool:
    """Print a line for each wire; return whether each is of class A with no check failed."""
    with contextlib.ExitStack() as stack:
        urls = stack.enter_context(on_this_machine())
        if shutil.which(BOARD[0]) and (OUT / "mps2-amplifier.elf").exists():
            urls |= stack.enter_context(on_the_board())
        runs = {place: start(url) for place, url in urls.items()}
        results = {place: json.loads(run.communicate()[0]) for place, run in runs.items()}
        for place in results:
            for _ in range(TRIES_ALONE):
                if not results[place]["failed"]:
                    break
                show(f"{place}, to be tried again", results[place])
                results[place] = json.loads(start(urls[place]).communicate()[0])
            show(place, results[place])
    return all(one["class"] == "A" and not one["failed"] for one in results.values())


def start(url: str) -> "subprocess.Popen[bytes]":
    """Start the suite on an amplifier."""
    command = [ERA, "amp", "conformance", url, "--write", "--json"]
    return subprocess.Popen(command, stdout=subprocess.PIPE)


def show(place: str, result: dict[str, object]) -> None:
    """Print a result: its counts, and each check that failed."""
    counts = (f"{result[kind]} {kind}" for kind in ("passed", "failed", "skipped", "inconclusive"))
    print(f"  {place}: class {result['class']}, {', '.join(counts)}", flush=True)
    for check in result["checks"]:  # type: ignore[attr-defined]
        if check["result"] == "failed":
            print(f"    {check['name']}: {check['reason']}")


@contextlib.contextmanager
def on_this_machine() -> Iterator[dict[str, str]]:
    """The program with each wire in a process of its own; yields the URLs."""
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
            urls[f"{options[0].strip('-')}, this machine"] = process.stdout.readline().strip()
        yield urls


@contextlib.contextmanager
def on_the_board() -> Iterator[dict[str, str]]:
    """The board with each wire in an emulator of its own; yields the URLs."""
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
            fragment = "#1" if scheme == "can+slcan" else ""
            urls[f"{scheme}, board in QEMU"] = f"{scheme}://{path}{fragment}"
        time.sleep(QEMU_LOOKS)
        yield urls


if __name__ == "__main__":
    sys.exit(not check_everywhere())
