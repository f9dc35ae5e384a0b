"""Polynomials over the plate: time and error of three plates, and of parameters that change live.

    python -m benchmarks.spectral [--repeats 15] [--large]

Processor time on one thread, medians: from nothing to 27 frequencies of four ERAs at 20 points, and
a further layout at places never seen before. What depends on degrees and h / L alone, integrals of
one dimension, is kept between repeats. Error: relative L2 over frequencies, ERAs and points against
elements of fifth order, half as many again along both sides as an accurate mesh has, with strips.
--large adds a plate of fourteen wavelengths a side, once, with an accurate mesh of elements beside
it, which takes minutes.
"""

import argparse
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from benchmarks.setting import use_one_thread

use_one_thread()

import numpy as np  # noqa: E402

from model.arrays import FloatArray  # noqa: E402
from model.fem.mesh import Mesh  # noqa: E402
from model.reduction.free_plate import solve_free_plate  # noqa: E402
from model.rig.file import example_rig_path, load_rig  # noqa: E402
from model.rig.meshes import mesh_of  # noqa: E402
from model.structure.actuator import Era  # noqa: E402
from model.structure.plate import Material, Plate  # noqa: E402
from model.vibration.discretisation import reference_mesh  # noqa: E402
from model.vibration.parametric_plate import parametric_plate  # noqa: E402

RIG = load_rig(example_rig_path())
GLASS = Material("glass", E=72e9, rho=2500.0, nu=0.23)
LAYOUTS = {
    "corners": [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)],
    "inset": [(0.25, 0.25), (0.75, 0.25), (0.5, 0.5), (0.0, 0.75)],
    "edges": [(0.3, 0.0), (0.61, 1.0), (0.0, 0.44), (1.0, 0.72)],
}
FOOT = 5e-3  # m


@dataclass(frozen=True)
class Case:
    """A plate with the text of its mesh, up to a frequency [Hz], ERAs on feet [m]."""

    name: str
    plate: Plate
    mesh: str
    frequency_max: float
    foot: float = 0.0


CASES = (
    Case("paper's plate", RIG.plate, "auto 1 %", 320.0),
    Case("paper's plate", RIG.plate, "auto 0.5 %", 320.0),
    Case("paper's plate, feet", RIG.plate, "auto 0.1 %", 320.0, FOOT),
    Case("530 x 300 x 1.1 mm glass", Plate(0.53, 0.30, 0.0011, GLASS), "auto 1 %", 320.0),
    Case("1200 x 800 x 4 mm glass", Plate(1.2, 0.8, 0.004, GLASS), "auto 1 %", 500.0),
)


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.spectral", description=__doc__)
    parser.add_argument("--repeats", type=int, default=15)
    parser.add_argument("--large", action="store_true")
    options = parser.parse_args()
    repeats = options.repeats
    print("| plate | mesh | from nothing | further layout | error: corners | inset | edges |")
    print("|---|---|---|---|---|---|---|")
    for case in CASES:
        print(_row(case, repeats), flush=True)
    print()
    print("| parameters of the paper's plate changed, 27 frequencies, 100 points | time |")
    print("|---|---|")
    for what, milliseconds in _live(repeats).items():
        print(f"| {what} | {milliseconds:.3f} ms |")
    if options.large:
        print("\n| 3600 x 2400 x 4 mm glass to 500 Hz | from nothing |\n|---|---|")
        _compare_large()


def _compare_large() -> None:
    plate, high = Plate(3.6, 2.4, 0.004, GLASS), 500.0
    polynomials = mesh_of("auto", plate, frequency_max=high, stiffness=RIG.eras[0].stiffness)
    eras = _on(plate, np.array(LAYOUTS["inset"]), 0.0)
    points = np.random.default_rng(1).uniform(0.03, 0.97, (20, 2)) * [plate.length, plate.width]
    for mesh in (polynomials, Mesh.accurate(plate, frequency_max=high)):
        started = time.process_time()
        solved = solve_free_plate(plate, mesh, frequency_max=high)
        solved.acceleration(eras, np.linspace(60.0, high, 27), points)
        print(f"| {mesh} | {time.process_time() - started:.2f} s |", flush=True)


def _row(case: Case, repeats: int) -> str:
    plate, high = case.plate, case.frequency_max
    frequencies = np.linspace(60.0, high, 27)
    rng = np.random.default_rng(1)
    points = rng.uniform(0.03, 0.97, (20, 2)) * [plate.length, plate.width]
    stiffness = RIG.eras[0].stiffness
    mesh = mesh_of(case.mesh, plate, frequency_max=high, stiffness=stiffness)
    corners = _on(plate, np.array(LAYOUTS["corners"]), case.foot)
    layouts = iter([_on(plate, rng.uniform(0, 1, (4, 2)), case.foot) for _ in range(repeats + 1)])
    free = solve_free_plate(plate, mesh, frequency_max=high)
    free.acceleration(corners, frequencies, points)

    def from_nothing() -> None:
        solved = solve_free_plate(plate, mesh, frequency_max=high)
        solved.acceleration(corners, frequencies, points)

    def further() -> None:
        free.acceleration(next(layouts), frequencies, points)

    times = [_median(each, repeats) for each in (from_nothing, further)]
    exact = solve_free_plate(plate, reference_mesh(plate, frequency_max=high), frequency_max=high)
    errors = []
    for shares in LAYOUTS.values():
        eras = _on(plate, np.array(shares), case.foot)
        found, expected = (each.acceleration(eras, frequencies, points) for each in (free, exact))
        errors.append(np.linalg.norm(found - expected) / np.linalg.norm(expected))
    cells = [
        case.name,
        f"{case.mesh}: {mesh}",
        *(f"{milliseconds:.2f} ms" for milliseconds in times),
        *(f"{100 * error:.2f} %" for error in errors),
    ]
    return f"| {' | '.join(cells)} |"


def _live(repeats: int) -> dict[str, float]:
    points = np.random.default_rng(0).uniform(0.01, 0.2, (100, 2))
    plate = parametric_plate(RIG, points, np.arange(60.0, 321.0, 10.0))
    eras = np.array([(era.stiffness, era.damping, era.bolt_mass) for era in RIG.eras])
    of = RIG.plate
    free = plate.receptances(of.material.E, of.loss_factor)

    def changed_plate() -> None:
        found = plate.receptances(1.01 * of.material.E, 0.02, thickness=1.01 * of.thickness)
        found.responses(eras, ())

    return {
        "stiffness, damping and bolt mass of ERAs": _median(
            lambda: free.responses(1.01 * eras, ()), 20 * repeats
        ),
        "modulus, thickness and loss factor": _median(changed_plate, 20 * repeats),
    }


def _on(plate: Plate, shares: FloatArray, foot: float) -> Sequence[Era]:
    """ERAs like those of the paper's plate at shares (n, 2) of a plate's sides."""
    like = RIG.eras[0]
    return [
        replace(like, name=f"E{number}", x=x, y=y, foot=foot)
        for number, (x, y) in enumerate((shares * [plate.length, plate.width]).tolist(), start=1)
    ]


def _median(run: Callable[[], object], repeats: int) -> float:
    """Median processor time [ms], after one run that is not counted."""
    run()
    times = []
    for _ in range(repeats):
        started = time.process_time_ns()
        run()
        times.append(time.process_time_ns() - started)
    return 1e-6 * statistics.median(times)


if __name__ == "__main__":
    main()
