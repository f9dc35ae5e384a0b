"""A plate of fourteen wavelengths a side, in polynomials and in elements, in some minutes.

python -m benchmarks.plate.large
"""

import time

from benchmarks.setting import use_one_thread

use_one_thread()

from benchmarks.plate.ours import eras_at  # noqa: E402
from benchmarks.plate.problem import GLASS, OTHERS, STIFFNESS, Case  # noqa: E402
from model.fem.mesh import Mesh  # noqa: E402
from model.reduction.free_plate import solve_free_plate  # noqa: E402
from model.rig.meshes import mesh_of  # noqa: E402
from model.structure.plate import Plate  # noqa: E402


def main() -> None:
    case = Case("3600 x 2400 x 4 mm glass", Plate(3.6, 2.4, 0.004, GLASS), 500.0)
    plate, high = case.plate, case.highest
    print(f"| {case.name} to 500 Hz | from nothing |\n|---|---|")
    polynomials = mesh_of("auto", plate, frequency_max=high, stiffness=STIFFNESS)
    for mesh in (polynomials, Mesh.accurate(plate, frequency_max=high)):
        started = time.process_time()
        solved = solve_free_plate(plate, mesh, frequency_max=high)
        solved.acceleration(eras_at(case, OTHERS[0]), case.frequencies, case.points)
        print(f"| {mesh} | {time.process_time() - started:.2f} s |", flush=True)


if __name__ == "__main__":
    main()
