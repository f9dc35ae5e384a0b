"""One measurement in a process of its own: prints a JSON object with seconds and peak memory.

    python -m benchmarks.plate.measure PROGRAM TASK NX NY

PROGRAM is a module below benchmarks. TASK is one of

    answers   the response at the common raster on two layouts, nothing timed
    nothing   from nothing to 27 frequencies and four drives at all nodes of the mesh
    layout    another layout on a plate that has been solved already
    places    the same, at places of a raster that has been solved for (ours alone)

Imports are not timed, since a program that is running has them behind it.
"""

import importlib
import json
import resource
import sys
import time
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from benchmarks.plate.problem import CORNERS, INSET, LENGTH, RASTER, WIDTH

REPEATS = 20


def main() -> None:
    program = importlib.import_module(f"benchmarks.plate.{sys.argv[1]}")
    task, nx, ny = sys.argv[2], int(sys.argv[3]), int(sys.argv[4])
    result = {"name": program.NAME, "method": program.METHOD}
    started = time.perf_counter()
    plate = program.Plate(nx, ny)
    first = plate.sweep(CORNERS, RASTER if task == "answers" else plate.points)
    result["seconds"] = time.perf_counter() - started
    result["dof"] = plate.dof
    if task == "answers":
        both = np.array([first, plate.sweep(INSET, RASTER)])
        result["answers"] = [both.real.tolist(), both.imag.tolist()]
    elif task == "layout":
        result["seconds"] = _time(lambda places: plate.sweep(places, RASTER))
    elif task == "places":
        x, y = np.meshgrid(np.linspace(0, LENGTH, 13), np.linspace(0, WIDTH, 13))
        candidates = program.Candidates(plate, np.column_stack([x.ravel(), y.ravel()]), RASTER)
        rng = np.random.default_rng(0)
        layouts = [rng.choice(len(candidates.places), 4, replace=False) for _ in range(REPEATS)]
        candidates.sweep(layouts[0])
        started = time.perf_counter()
        for layout in layouts:
            candidates.sweep(layout)
        result["seconds"] = (time.perf_counter() - started) / len(layouts)
    kilobytes = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    print(json.dumps(result | {"peak_mb": kilobytes / 1024}))


def _time(sweep: Callable[[NDArray[np.float64]], object]) -> float:
    """Seconds a layout: of one where that takes long, else the mean of many, each elsewhere."""
    started = time.perf_counter()
    sweep(INSET)
    once = time.perf_counter() - started
    if once > 0.1:
        return once
    started = time.perf_counter()
    for number in range(REPEATS):
        sweep(INSET * (1 - 0.01 * (number + 1)))  # never seen before
    return (time.perf_counter() - started) / REPEATS


if __name__ == "__main__":
    main()
