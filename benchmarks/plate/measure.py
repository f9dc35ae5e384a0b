"""Errors and times of programs: processor time on one thread, all programs in turns."""

import statistics
import time
from dataclasses import dataclass, field

import numpy as np

from benchmarks.plate.problem import CORNERS, OTHERS, Case, difference
from benchmarks.plate.programs import Setting, Solved, reference, settings
from model.arrays import FloatArray

SLOW = 0.3  # s; a setting that takes longer is measured in the first rounds alone
SLOW_ROUNDS = 3


@dataclass
class Measured:
    """Relative L2 errors of a setting at the corners, and the largest elsewhere; seconds."""

    setting: Setting
    corners: float
    elsewhere: float
    all_nothing: list[float] = field(default_factory=list)
    all_further: list[float] = field(default_factory=list)

    @property
    def anywhere(self) -> float:
        """The larger of both errors."""
        return max(self.corners, self.elsewhere)

    @property
    def nothing(self) -> float:
        """Median seconds from nothing to the sweep of one layout."""
        return statistics.median(self.all_nothing)

    @property
    def further(self) -> float:
        """Median seconds of a further layout at four places never seen before."""
        return statistics.median(self.all_further)


def measure(case: Case, rounds: int) -> list[Measured]:
    """All settings of a case: errors against the reference, and times."""
    exact = reference(case)
    layouts = (CORNERS, *OTHERS)
    expected = exact.sweeps(layouts)
    found, solved = [], []
    for setting in settings(case):
        plate = setting.solve()
        errors = [
            difference(each, answer)
            for each, answer in zip(plate.sweeps(layouts), expected, strict=True)
        ]
        found.append(Measured(setting, errors[0], max(errors[1:])))
        solved.append(plate)
    rng = np.random.default_rng(0)
    for number in range(rounds):
        layout = rng.uniform(0, 1, (4, 2))
        for each, plate in zip(found, solved, strict=True):
            if number < SLOW_ROUNDS or each.nothing < SLOW:
                _run(each, plate, layout)
    return found


def _run(measured: Measured, solved: Solved, layout: FloatArray) -> None:
    started = time.process_time()
    measured.setting.solve().sweep(CORNERS)
    measured.all_nothing.append(time.process_time() - started)
    started = time.process_time()
    solved.sweep(layout)
    measured.all_further.append(time.process_time() - started)
