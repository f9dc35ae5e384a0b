"""The software amplifier behind the daemon: touch to sound, silence once killed, lost blocks.

    python -m benchmarks.desk.soft_amp [--touches 100] [--load 300] [--report]

A JACK server of the dummy driver, asynchronous, with real-time priority where that is allowed;
`era soft-amp` and `era daemon` are processes of their own, and a client of the server, in C, notes
every sample and when its block came.
"""

import argparse
import contextlib
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.desk.capture import Capture
from benchmarks.desk.session import ERA, EXAMPLES, RATE, running
from benchmarks.desk.touches import connected, until_ready
from benchmarks.page import write_parts
from benchmarks.setting import use_one_thread
from controller.api.client import Client

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "measured" / "soft-amp.md"
BLOCKS = (64, 128, 256, 512)
CHANNELS = 4
_SILENT = 0.4  # s after a finger has left
_PATIENCE = 20.0  # s
_REPEAT = 0.05  # s; a contact that is not confirmed is lifted
_GAPS = re.compile(r"(\d+) gaps in the sound, (\d+) underruns reported by the driver, in (\d+) s")


@dataclass
class Bench:
    """What runs; amplifier: the process that watches the one that plays."""

    capture: Capture
    era: Client
    lease: str
    amplifier: "subprocess.Popen[str]"
    daemon: "subprocess.Popen[str]"

    @property
    def player(self) -> int:
        """The process that plays."""
        path = Path(f"/proc/{self.amplifier.pid}/task/{self.amplifier.pid}/children")
        return int(path.read_text().split()[0])


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.desk.soft_amp", description=__doc__)
    parser.add_argument("--touches", type=int, default=100, help="at each size of blocks")
    parser.add_argument("--load", type=float, default=300.0, help="s beside busy processes")
    parser.add_argument("--report", action="store_true", help=f"write {PAGE.relative_to(ROOT)}")
    options = parser.parse_args()
    use_one_thread()
    if options.report and not PAGE.exists():
        parser.error(f"--report writes parts of {PAGE}, which must exist")

    def write(name: str, part: str) -> None:
        """Write what was measured at once: another part may fail later."""
        print(part, flush=True)
        if options.report:
            write_parts(PAGE, {name: part})

    with tempfile.TemporaryDirectory(prefix="soft-amp") as name:
        folder = Path(name)
        _table(folder)
        rows = [
            "| block / frames | touches | median / ms | 99th percentile / ms | longest / ms |",
            "|---|---|---|---|---|",
        ]
        for block in BLOCKS:
            with bench(folder, block=block) as running_bench:
                found = touch_to_sound(running_bench, options.touches)
            if found is None:
                rows.append(f"| {block} | in fault: too many gaps | | | |")
            else:
                median, late = np.percentile(1e3 * found, [50, 99])
                rows.append(
                    f"| {block} | {len(found)} | {median:.1f} | {late:.1f} | "
                    f"{1e3 * found.max():.1f} |"
                )
            print(rows[-1], flush=True)
        write("touches", "\n".join(rows))
        write("silence", silences(folder))
        write("underruns", underruns(folder, options.load))


def _table(folder: Path) -> None:
    """The example's plate, as written, with few frequencies."""
    text = (EXAMPLES / "rig.yaml").read_text("utf-8")
    (folder / "rig.yaml").write_text(text.replace("/tmp/plate", str(folder / "amp")), "utf-8")
    config = "rig: rig.yaml\ntable: table.npz\nsocket: era.sock\nlevel_db_sl: 20\n"
    (folder / "daemon.yaml").write_text(config, "utf-8")
    command = [ERA, "table", "build", "rig.yaml", "-o", "table.npz", "--mode", "phased"]
    subprocess.run([*map(str, command), "--frequencies", "90:330:40"], cwd=folder, check=True)


@contextlib.contextmanager
def bench(folder: Path, *, block: int) -> Iterator[Bench]:
    """Server, capturing client, amplifier, and an armed daemon."""
    name = f"softamp{os.getpid()}"
    os.environ |= {"JACK_DEFAULT_SERVER": name, "JACK_NO_START_SERVER": "1"}
    priority = ["-R", "-P10"] if os.geteuid() == 0 else ["-r"]
    server = ["jackd", "-n", name, *priority, "-d", "dummy", "-p", block, "-r", RATE]
    amplifier = [ERA, "soft-amp", "--device", "jack:card", "--channels", CHANNELS]
    amplifier += ["--link", folder / "amp", "--until-eof", "--max-gaps", 63]  # counted, no fault
    with contextlib.ExitStack() as stack:
        log = stack.enter_context((folder / "log").open("w"))
        running(stack, server, folder, os.environ, log)
        capture = Capture("card", CHANNELS)
        stack.callback(capture.close)
        playing = running(stack, amplifier, folder, os.environ, log)
        assert playing.stdout is not None
        playing.stdout.readline()
        daemon = running(stack, [ERA, "daemon", "daemon.yaml"], folder, os.environ, log)
        era = stack.enter_context(connected(folder / "era.sock"))
        until_ready(era)
        lease = era.arm("bench", lease_s=60).lease
        yield Bench(capture, era, lease, playing, daemon)


def touch_to_sound(
    bench: Bench, count: int
) -> "np.ndarray[tuple[int], np.dtype[np.float64]] | None":
    """Time [s] from calling `touch` to the first sample, for fingers at random places.

    None for an amplifier that fell into a fault, as one does whose blocks are too short.
    """
    rng = np.random.default_rng(0)
    found = []
    for _ in range(count):
        place = (float(rng.uniform(0.03, 0.27)), float(rng.uniform(0.03, 0.2)))
        bench.era.renew(bench.lease)
        _until(lambda: not bench.capture.is_sounding())
        time.sleep(_SILENT + float(rng.uniform(0, 0.02)))
        since, touched = bench.capture.position, time.monotonic()
        bench.era.touch([place])
        _until(lambda: bench.capture.is_sounding() or bench.era.status().state == "FAULT")
        if not bench.capture.is_sounding():
            return None
        found.append(bench.capture.first_sound(since) - touched)
        bench.era.touch([])
    return np.array(found)


def silences(folder: Path) -> str:
    """Last sound after a signal, of blocks of 128 frames."""
    rows = ["| what ends | signal | last block with sound after / ms |", "|---|---|---|"]
    for what, number, process in (
        ("the daemon", signal.SIGKILL, lambda found: found.daemon.pid),
        ("the daemon", signal.SIGSTOP, lambda found: found.daemon.pid),
        ("`era soft-amp`, the process that watches", signal.SIGKILL, lambda f: f.amplifier.pid),
        ("`era soft-amp`, the process that plays", signal.SIGKILL, lambda found: found.player),
        ("`era soft-amp`, the process that plays", signal.SIGSTOP, lambda found: found.player),
    ):
        after = 1e3 * _silence(folder, number, process)
        rows.append(f"| {what} | {number.name} | {after:.0f} |")
    return "\n".join(rows)


def _silence(folder: Path, number: signal.Signals, process: Callable[[Bench], int]) -> float:
    with bench(folder, block=128) as found:
        _play(found, 1.0)
        pid = process(found)
        os.kill(pid, number)
        done = time.monotonic()
        time.sleep(1.0)
        _until(lambda: not found.capture.is_sounding())
        last = found.capture.last_sound()
        if number is signal.SIGSTOP:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        return last - done


def underruns(folder: Path, seconds: float) -> str:
    """Lost blocks while it plays beside two busy processes for each processor."""
    busy = [sys.executable, "-c", "while True: pass"]
    with contextlib.ExitStack() as stack:
        found = stack.enter_context(bench(folder, block=128))
        for _ in range(2 * (os.cpu_count() or 1)):
            process = stack.enter_context(subprocess.Popen(busy))
            stack.callback(process.kill)
        _play(found, seconds)
    counted = _GAPS.findall((folder / "log").read_text("utf-8"))[-1]
    gaps, reported, whole = map(int, counted)
    return "\n".join(
        [
            "| played / s | gaps | by the hour | underruns reported by the driver |",
            "|---|---|---|---|",
            f"| {whole} | {gaps} | {3600 * gaps / whole:.0f} | {reported} |",
        ]
    )


def _play(bench: Bench, seconds: float) -> None:
    """Hold a finger."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        bench.era.renew(bench.lease)
        bench.era.touch([(0.1, 0.1)])
        time.sleep(_REPEAT)
    if not bench.capture.is_sounding():
        raise RuntimeError("nothing plays in the end")


def _until(is_true: Callable[[], bool]) -> None:
    end = time.monotonic() + _PATIENCE
    while not is_true():
        if time.monotonic() > end:
            raise RuntimeError("neither sound nor silence came in time")
        time.sleep(0.002)


if __name__ == "__main__":
    main()
