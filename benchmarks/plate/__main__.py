"""The plate model beside NGSolve: error and processor time of each, on one thread.

    python -m benchmarks.plate [--runs 5] [--no-study] [-o docs]

Both take turns in one process. Writes measured/benchmarks.md and its picture. Needs the extras
group `peers`.
"""

import argparse
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from benchmarks.plate.measure import (
    SLOW,
    SLOW_ROUNDS,
    measure,
    write_report,
)
from benchmarks.plate.programs import CASES
from benchmarks.setting import RIG

LAYOUTS, WORKERS, STUDIES = 10_000, 2, 3


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.plate", description=__doc__)
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--no-study", action="store_true", help="without ten thousand layouts")
    parser.add_argument("-o", "--output", type=Path, default=Path(__file__).parents[2] / "docs")
    options = parser.parse_args()

    note = f"Medians of {options.runs} runs, of {SLOW_ROUNDS} above {SLOW:g} s. Reference: NGSolve."
    measured = {}
    for case in CASES:
        measured[case] = measure(case, options.runs)
        print(f"{case.name}: done", file=sys.stderr)
    seconds = None
    if not options.no_study:
        elapsed, processor = zip(*(study() for _ in range(STUDIES)), strict=True)
        seconds = statistics.median(elapsed), statistics.median(processor)
    write_report(measured, seconds, note, options.output)


def study() -> tuple[float, float]:
    """Seconds and processor seconds of `era design --layouts` over ten thousand layouts.

    From the start of the command, of all its processes.
    """
    with tempfile.TemporaryDirectory() as folder:
        command = [
            str(Path(sys.executable).with_name("era")), "design",
            str(RIG), "--layouts", f"random:{LAYOUTS}",
            "--workers", str(WORKERS), "-o", folder, "--json",
        ]  # fmt: skip
        started, used = time.perf_counter(), _used()
        environment = os.environ | {"XDG_CACHE_HOME": folder}
        # Users' modules are compiled once; without this each start would compile them all.
        environment.pop("PYTHONDONTWRITEBYTECODE", None)
        subprocess.run(command, env=environment, check=True, capture_output=True)
        return time.perf_counter() - started, _used() - used


def _used() -> float:
    """Processor time [s] of processes that were started and have ended."""
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return children.ru_utime + children.ru_stime


if __name__ == "__main__":
    main()
