"""Statistics of the cases of a study, solved by its workers."""

import hashlib
import json
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from model.arrays import ComplexArray, FloatArray
from model.errors import InputError
from model.fem.plate_mesh import check_frequencies
from model.rig.rig import Rig
from model.structure.actuator import Era
from model.studies.cases import Cases
from model.studies.receptances import Receptances, solve_receptances
from model.version import NUMERICS_VERSION
from model.vibration.activation import (
    MEDIAN,
    STATISTICS,
    activation_sets,
    cumulative_statistics,
    equal_area_points,
    felt_acceleration,
)

DRIVES = ("1", "2", "all")
"""Numbers of active ERAs: the best single one, the best pair, and all of a case."""


DRIVE_NAMES = {"1": "best single ERA", "2": "best pair of ERAs", "all": "all ERAs"}


@dataclass(frozen=True)
class StudyProblem:
    """Inputs of the statistics of all cases.

    positions (c, 2) [m]: possible places of ERAs; frequencies (f,) [Hz].
    """

    rig: Rig
    positions: FloatArray
    frequencies: FloatArray

    @property
    def points(self) -> FloatArray:
        """Points [m] (p, 2) over which the statistics are taken."""
        highest = float(self.frequencies.max())
        return equal_area_points(self.rig.plate, frequency_max=highest)

    @property
    def digest(self) -> str:
        """SHA-256 over all but the positions, which are part of the cases."""
        digest = hashlib.sha256()
        mesh = json.dumps(self.rig.mesh.to_dict(), sort_keys=True)
        for text in (self.rig.fingerprint, mesh, NUMERICS_VERSION):
            digest.update(f"{text}\n".encode())
        digest.update(self.frequencies.tobytes())
        return digest.hexdigest()

    def solve(self) -> Receptances:
        """Solve the plate, once for all cases; raises InputError as `solve_receptances` does."""
        return solve_receptances(self.rig, self.positions, self.points, self.frequencies)


@dataclass(frozen=True)
class CaseResults:
    """Statistics (n, 3, 6) of n cases, a row for each of DRIVES; NaN for too few ERAs.

    active: (n, 3), bit k set where ERA k of the case is driven.
    """

    statistics: FloatArray
    active: NDArray[np.uint64]

    def active_eras(self, case: int, drive: int) -> tuple[int, ...]:
        """Numbers of the ERAs that are driven."""
        bits = int(self.active[case, drive])
        return tuple(era for era in range(bits.bit_length()) if bits >> era & 1)


def empty_results(count: int) -> CaseResults:
    """Results to be filled in for a number of cases."""
    return CaseResults(
        np.full((count, len(DRIVES), len(STATISTICS)), np.nan),
        np.zeros((count, len(DRIVES)), dtype=np.uint64),
    )


def study_problem(rig: Rig, cases: Cases, frequencies: FloatArray) -> StudyProblem:
    """The problem of a study; raises InputError for frequencies (f,) [Hz] out of range."""
    if len(frequencies) == 0:
        raise InputError("frequencies of a study must be at least one, got none")
    check_frequencies(rig.plate, rig.mesh, frequencies)
    return StudyProblem(rig, cases.positions, frequencies)


def solve_cases(receptances: Receptances, eras: tuple[Era, ...], cases: Cases) -> CaseResults:
    """Solve cases with ERAs like those of the rig; none depends on another."""
    felt = felt_acceleration(receptances.frequencies)
    results = empty_results(len(cases))
    buffers: dict[int, ComplexArray] = {}
    for case in range(len(cases)):
        placed = cases.eras_of(case, eras)
        if len(placed) not in buffers:
            buffers[len(placed)] = receptances.buffer(len(placed))
        acceleration = receptances.acceleration(
            cases.places_of(case), placed, buffer=buffers[len(placed)]
        )
        every = cumulative_statistics(acceleration, felt=felt)
        sets = activation_sets(len(placed))
        for drive, size in enumerate((1, 2, len(placed))):
            rows = [row for row, members in enumerate(sets) if len(members) == size]
            if not rows:
                continue
            # Of sets that are equal by symmetry the first, not the one that rounding favours.
            best = max(rows, key=lambda row: float(f"{every[row, MEDIAN]:.9g}"))
            results.statistics[case, drive] = every[best]
            results.active[case, drive] = sum(1 << era for era in sets[best])
    return results
