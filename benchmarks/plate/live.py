"""Parameters of the paper's plate that change without solving it again."""

import statistics
import time
from collections.abc import Callable

import numpy as np

from benchmarks.setting import RIG
from model.rig.file import load_rig
from model.vibration.parametric_plate import parametric_plate

REPEATS = 300


def live() -> dict[str, float]:
    """Median seconds of 27 frequencies, four ERAs and 100 points, by what has changed."""
    rig = load_rig(RIG)
    points = np.random.default_rng(0).uniform(0.01, 0.2, (100, 2))
    plate = parametric_plate(rig, points, np.linspace(60.0, 320.0, 27))
    eras = np.array([(era.stiffness, era.damping, era.bolt_mass) for era in rig.eras])
    of = rig.plate
    free = plate.receptances(of.material.E, of.loss_factor, of.thickness)

    def changed_plate() -> None:
        found = plate.receptances(1.01 * of.material.E, 0.02, thickness=1.01 * of.thickness)
        found.responses(eras, ())

    return {
        "stiffness, damping and bolt mass of ERAs": _median(
            lambda: free.responses(1.01 * eras, ())
        ),
        "modulus, thickness and loss factor": _median(changed_plate),
    }


def _median(run: Callable[[], object]) -> float:
    """Median processor time [s], after one run that is not counted."""
    run()
    times = []
    for _ in range(REPEATS):
        started = time.process_time_ns()
        run()
        times.append(time.process_time_ns() - started)
    return 1e-9 * statistics.median(times)
