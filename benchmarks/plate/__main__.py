"""The plate model beside its peers: the same plate, supports, frequencies and loads.

    python -m benchmarks.plate [--runs 5] [-o docs]

Checks first that all programs agree, then measures, each time in a process of its own and on one
thread; writes measured/benchmarks.md and its picture. Needs the extras group
`peers`.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from benchmarks.plate.report import Result, write_report
from benchmarks.setting import ONE_THREAD, RIG
from model.arrays import ComplexArray

ROOT = Path(__file__).parents[2]
OURS = "ours"
PEERS = ("peers.scikit_fem_plate", "peers.pyfe3d_plate", "peers.ngsolve_plate")
MESH, FINE, FINEST = (48, 36), (96, 72), (192, 144)
LAYOUTS, WORKERS = 10_000, 2

# How far a peer may be from us (relative L2 over all frequencies, drives and points) with four
# times as many elements. Near a resonance a natural frequency 0.2 % off, which is what a thin-plate
# theory or a mesh of that size has, already makes several percent.
AGREEMENT = 0.1


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.plate", description=__doc__)
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("-o", "--output", type=Path, default=ROOT / "docs")
    options = parser.parse_args()

    agreement = check_answers()
    measured: dict[str, list[Result]] = {}
    loads = []
    for run in range(options.runs):  # in turns, so that a slow minute affects all
        for program in (OURS, *PEERS):
            for task in ("nothing", "layout"):
                measured.setdefault(f"{task} {program}", []).append(measure(program, task, MESH))
        for task, mesh in (("places", MESH), ("nothing", FINEST), ("nothing", (0, 0))):
            name = f"{task} {OURS} {mesh[0]}"
            measured.setdefault(name, []).append(measure(OURS, task, mesh))
        measured.setdefault("study", []).append(study())
        loads.append(os.getloadavg()[0])
        print(f"run {run + 1} of {options.runs} done", file=sys.stderr)
    measured["nothing peer finest"] = [measure(fastest(measured), "nothing", FINEST)]
    write_report(
        {name: median(runs) for name, runs in measured.items()},
        agreement,
        peers=PEERS,
        fastest=fastest(measured),
        loads=loads,
        folder=options.output,
    )


def measure(program: str, task: str, mesh: tuple[int, int]) -> Result:
    """What one process of `benchmarks.plate.measure` prints."""
    command = [sys.executable, "-m", "benchmarks.plate.measure", program, task, *map(str, mesh)]
    environment = os.environ | ONE_THREAD
    done = subprocess.run(
        command, cwd=ROOT, env=environment, check=True, capture_output=True, text=True
    )
    result: Result = json.loads(done.stdout.splitlines()[-1])
    return result


def check_answers() -> list[Result]:
    """Difference of all programs from our elements of order 5; SystemExit where it is too large.

    Relative L2 over 27 frequencies, four drives and 221 points, on two layouts.
    """
    converged = _answers(measure(OURS, "answers", (0, 0)))
    rows = []
    for program in (OURS, *PEERS):
        row: Result = {}
        for mesh in (MESH, FINE):
            result = measure(program, "answers", mesh)
            answers = _answers(result)
            distance = np.linalg.norm(answers - converged) / np.linalg.norm(converged)
            each = np.linalg.norm(answers - converged, axis=-1) / np.linalg.norm(converged, axis=-1)
            row |= {"name": result["name"], "method": result["method"]}
            row[mesh] = {"all": distance, "median": np.median(each), "dof": result["dof"]}
        rows.append(row)
        if row[FINE]["all"] > AGREEMENT:
            raise SystemExit(f"{row['name']} does not give our answer: {row}")
        print(f"{row['name']}: {row[FINE]['all']:.1%} from ours at 96x72", file=sys.stderr)
    return rows


def _answers(result: Result) -> ComplexArray:
    real, imaginary = result["answers"]
    return np.array(real) + 1j * np.array(imaginary)


def study() -> Result:
    """`era study placement` over ten thousand layouts, start of the command included."""
    with tempfile.TemporaryDirectory() as folder:
        command = [
            str(Path(sys.executable).with_name("era")), "study", "placement",
            str(RIG), "--layouts", str(LAYOUTS),
            "--workers", str(WORKERS), "-o", folder, "--json",
        ]  # fmt: skip
        watch = (
            "import resource, subprocess, sys; subprocess.run(sys.argv[1:], check=True, "
            "stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL); "
            "print(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024)"
        )
        environment = os.environ | {"XDG_CACHE_HOME": folder}
        started = time.perf_counter()
        done = subprocess.run(
            [sys.executable, "-c", watch, *command],
            env=environment, check=True, capture_output=True, text=True,
        )  # fmt: skip
        seconds = time.perf_counter() - started
    return {"seconds": seconds, "peak_mb": float(done.stdout)}


def median(runs: list[Result]) -> Result:
    """One measurement that stands for several: medians, and how far the fastest and slowest lie."""
    seconds = [run["seconds"] for run in runs]
    return runs[0] | {
        "seconds": statistics.median(seconds),
        "least": min(seconds),
        "most": max(seconds),
        "peak_mb": statistics.median(run["peak_mb"] for run in runs),
    }


def fastest(measured: dict[str, list[Result]]) -> str:
    """The peer that is fastest from nothing."""
    return min(PEERS, key=lambda peer: median(measured[f"nothing {peer}"])["seconds"])


if __name__ == "__main__":
    main()
