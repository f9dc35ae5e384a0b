"""Large plates in polynomials, and one in elements: time, memory and difference, in two minutes.

python -m benchmarks.plate.large
"""

import multiprocessing
import resource
import time

import numpy as np

from benchmarks.setting import use_one_thread

use_one_thread()

from benchmarks.plate.ours import eras_at  # noqa: E402
from benchmarks.plate.problem import GLASS, OTHERS, STIFFNESS, Case, difference  # noqa: E402
from model.arrays import ComplexArray  # noqa: E402
from model.fem.mesh import Mesh  # noqa: E402
from model.reduction.free_plate import solve_free_plate  # noqa: E402
from model.rig.meshes import mesh_of  # noqa: E402
from model.spectral.mesh import PlateMesh  # noqa: E402
from model.structure.plate import Plate  # noqa: E402

FOOT = 0.02  # m
SIDES = ((1.2, 0.8), (3.0, 2.0), (6.0, 4.0))
WITH_ELEMENTS = (3.0, 2.0)
FURTHER = 8  # degrees of what a response is compared with


def main() -> None:
    print("| plate | mesh | time | memory | difference |\n|---|---|---|---|---|")
    for sides in SIDES:
        plate = Plate(*sides, 0.004, GLASS)
        case = Case("glass", plate, 500.0, foot=FOOT)
        auto = mesh_of("auto", plate, frequency_max=500.0, stiffness=STIFFNESS, foot=FOOT)
        finer = f"{auto.nx + FURTHER}x{auto.ny + FURTHER} Legendre"
        meshes = [auto, mesh_of(finer, plate, frequency_max=500.0)]
        if sides == WITH_ELEMENTS:
            meshes.append(Mesh.accurate(plate, frequency_max=500.0))
        first = None
        for mesh in meshes:
            # A process for each, since memory is that of the largest so far.
            with multiprocessing.get_context("spawn").Pool(1) as pool:
                answer, seconds, memory = pool.apply(solve, (case, mesh))
            first = answer if first is None else first
            off = "" if answer is first else f"{100 * difference(first, answer):.2f} %"
            print(
                f"| {sides[0]:g} x {sides[1]:g} m | {mesh} | {seconds:.2f} s | {memory:.2f} GB | "
                f"{off} |",
                flush=True,
            )


def solve(case: Case, mesh: PlateMesh) -> tuple[ComplexArray, float, float]:
    """Response, seconds of processor time, and memory [GB] of the process."""
    started = time.process_time()
    solved = solve_free_plate(case.plate, mesh, frequency_max=case.highest)
    answer = solved.acceleration(eras_at(case, OTHERS[0]), case.frequencies, case.points)
    seconds = time.process_time() - started
    return np.asarray(answer), seconds, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6


if __name__ == "__main__":
    main()
