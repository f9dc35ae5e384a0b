"""Expected contrast and loudness of the cases of a study, solved by its workers."""

import hashlib
import json
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from model.arrays import Complex64Array, FloatArray, IntArray
from model.choice import best_along
from model.design.contacts import ContactRule
from model.design.places import DesignPlate, Places
from model.design.score import Mounts, Scorer
from model.design.search import SEARCH_FINGERS, search_frequencies
from model.design.support import DEFAULT_LOWEST
from model.errors import InputError
from model.fem.plate_mesh import check_frequencies
from model.finger.perception import check_has_threshold
from model.rig.rig import Rig
from model.structure.dynamic_stiffness import full_strokes
from model.studies.cases import VACANT, Cases, all_alike
from model.studies.receptances import Receptances, solve_receptances
from model.studies.supported import support_of
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

SETS_SEED = 0
"""Seed of the contact sets of every study, so that studies compare."""

DRIVE_NAMES = {"1": "best single ERA", "2": "best pair of ERAs", "all": "all ERAs"}


@dataclass(frozen=True)
class StudyProblem:
    """Inputs of what is known of all cases.

    positions (c, 2) [m]: possible places of ERAs; frequencies (f,) [Hz]: of loudness; sets: contact
    sets (fingers, 2) [m] of expected contrast, target first; lowest [Hz]: least rigid-body
    frequency of a case that supports the plate. Raises InputError for frequencies without data on
    thresholds.
    """

    rig: Rig
    positions: FloatArray
    frequencies: FloatArray
    sets: tuple[FloatArray, ...]
    lowest: float

    def __post_init__(self) -> None:
        """Refuse frequencies at which nothing is known of what is felt."""
        check_has_threshold(self.frequencies)

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
        for text in (self.rig.fingerprint, mesh, NUMERICS_VERSION, self.lowest):
            digest.update(f"{text}\n".encode())
        for numbers in (self.frequencies, search_frequencies(self.rig), *self.sets):
            digest.update(numbers.tobytes())
        return digest.hexdigest()

    def solve(self) -> "SolvedStudy":
        """Solve the plate, once for all cases; raises InputError as `solve_receptances` does."""
        receptances = solve_receptances(self.rig, self.positions, self.points, self.frequencies)
        plate = DesignPlate(self.rig, search_frequencies(self.rig), self.sets)
        return SolvedStudy(
            self.rig, receptances, plate.places(self.positions), Scorer(plate), self.lowest
        )


@dataclass(frozen=True, eq=False)
class SolvedStudy:
    """The plate of a study, solved for all positions: for loudness, and places for contrast."""

    rig: Rig
    receptances: Receptances
    places: Places
    scorer: Scorer
    lowest: float


@dataclass(frozen=True)
class CaseResults:
    """Results of n cases.

    expected_db (n,): expected contrast as `era design` scores it, NaN where the plate is not
    supported; statistics (n, 3, 6): of loudness, a row for each of DRIVES, NaN for too few ERAs;
    active (n, 3): bit k set where ERA k of the case is driven for it.
    """

    expected_db: FloatArray
    statistics: FloatArray
    active: NDArray[np.uint64]

    def active_eras(self, case: int, drive: int) -> tuple[int, ...]:
        """Numbers of the ERAs that are driven."""
        bits = int(self.active[case, drive])
        return tuple(era for era in range(bits.bit_length()) if bits >> era & 1)


def empty_results(count: int) -> CaseResults:
    """Results to be filled in for a number of cases."""
    return CaseResults(
        np.full(count, np.nan),
        np.full((count, len(DRIVES), len(STATISTICS)), np.nan),
        np.zeros((count, len(DRIVES)), dtype=np.uint64),
    )


def study_problem(
    rig: Rig,
    cases: Cases,
    frequencies: FloatArray,
    *,
    contacts: ContactRule,
    lowest: float = DEFAULT_LOWEST,
) -> StudyProblem:
    """The problem of a study; raises InputError for frequencies (f,) [Hz] out of range."""
    if len(frequencies) == 0:
        raise InputError("frequencies of a study must be at least one, got none")
    check_frequencies(rig.plate, rig.mesh, frequencies)
    sets = tuple(contacts.pooled_sets(SEARCH_FINGERS, seed=SETS_SEED))
    return StudyProblem(rig, cases.positions, frequencies, sets, lowest)


def solve_cases(solved: SolvedStudy, cases: Cases) -> CaseResults:
    """Solve cases with ERAs like those of the rig; none depends on another."""
    results = empty_results(len(cases))
    receptances, eras = solved.receptances, solved.rig.eras
    mounts, counts = cases.mounts(eras), (cases.places != VACANT).sum(axis=1)
    omega = 2 * np.pi * receptances.frequencies
    for count in np.unique(counts).tolist():
        rows = np.flatnonzero(counts == count)
        driven = eras[:1] * count if all_alike(eras) else eras
        places = cases.places[rows, :count].astype(np.int64)
        forces = receptances.forces(places, mounts[rows, :count], full_strokes(driven, omega))
        _solve_layouts(receptances, rows, places, forces, results)
    _score(solved, cases, results)
    return results


def _score(solved: SolvedStudy, cases: Cases, results: CaseResults) -> None:
    """Fill in the expected contrast of cases that support the plate."""
    support = support_of(solved.rig, cases, lowest=solved.lowest)
    mounts: dict[tuple[int, float], Mounts] = {}  # of one kind of case they are the same anywhere
    for case in np.flatnonzero(support.is_supported).tolist():
        chosen = cases.places_of(case)
        kind = len(chosen), float(cases.stiffness_factors[case])
        if kind not in mounts:
            mounts[kind] = solved.scorer.mounts(cases.eras_of(case, solved.rig.eras))
        results.expected_db[case] = solved.scorer.mean(solved.places, chosen, mounts[kind])


def _solve_layouts(
    receptances: Receptances,
    rows: IntArray,
    places: IntArray,
    forces: Complex64Array,
    results: CaseResults,
) -> None:
    """Fill in these rows of the results, of layouts with the same number of ERAs."""
    felt = felt_acceleration(receptances.frequencies)
    count = places.shape[1]
    sets = activation_sets(count)
    bits = np.array([sum(1 << era for era in members) for members in sets], dtype=np.uint64)
    sizes = np.array([len(members) for members in sets])
    of_drives = [np.flatnonzero(sizes == size) for size in (1, 2, count)]
    buffer = receptances.buffer(count)
    every = np.empty((len(rows), len(sets), len(STATISTICS)))
    for number, (at, force) in enumerate(zip(places, forces, strict=True)):
        every[number] = cumulative_statistics(receptances.fields(at, force, buffer), felt=felt)
    for drive, numbers in enumerate(of_drives):
        if not len(numbers):
            continue
        medians = every[:, numbers, MEDIAN]
        best = numbers[best_along(medians, axis=1)]
        results.statistics[rows, drive] = every[np.arange(len(rows)), best]
        results.active[rows, drive] = bits[best]
