"""Ranking of the cases of a study, and the recommended one."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from model.arrays import FloatArray, IntArray
from model.counting import counted
from model.errors import InputError
from model.rig.rig import Rig
from model.structure.support import MIN_RIGID_BODY_FREQUENCY, rigid_body_frequencies_of
from model.studies.cases import OWN, VACANT, Cases
from model.studies.solve import EQUAL, CaseResults
from model.vibration.activation import MEDIAN

GOOD_ENOUGH = 0.9
"""Share of the best median at which fewer or softer ERAs are recommended."""


@dataclass(frozen=True)
class Ranking:
    """Cases by the median over the plate under a drive, the best first.

    drive: number in DRIVES; order (n,): cases that have ERAs enough for it; supported (n,):
    whether the ERAs of each case support the plate.
    """

    cases: Cases
    results: CaseResults
    drive: int
    order: IntArray
    supported: NDArray[np.bool_]

    @property
    def medians(self) -> FloatArray:
        """Median cumulative peak acceleration [m/s²] of each case, NaN for too few ERAs."""
        return np.asarray(self.results.statistics[:, self.drive, MEDIAN])

    @property
    def best(self) -> int:
        """The case of rank one."""
        return int(self.order[0])

    @property
    def middle(self) -> int:
        """The case in the middle of the ranking."""
        return int(self.order[len(self.order) // 2])

    @property
    def worst(self) -> int:
        """The last case."""
        return int(self.order[-1])

    @property
    def own(self) -> int | None:
        """The rig's own layout, if it is among the ranked cases."""
        for case in self.order:
            if self.cases.names[case] == OWN and self.cases.stiffness_factors[case] == 1:
                return int(case)
        return None

    @property
    def recommended(self) -> int:
        """The case with fewest and softest ERAs among those that reach GOOD_ENOUGH of the best.

        In a study of placement that is the best case. Cases that do not support the plate are
        passed over.
        """
        counts = era_counts(self.cases)
        order = self.order[self.supported[self.order]]
        good = [
            int(case)
            for case in order
            if self.medians[case] >= GOOD_ENOUGH * self.medians[order[0]]
        ]
        return min(good, key=lambda case: (counts[case], self.cases.stiffness_factors[case]))

    def best_by(self, values: FloatArray | IntArray) -> dict[float, int]:
        """The best case for each distinct value (n,), such as the number of ERAs; ascending."""
        best: dict[float, int] = {}
        for case in self.order:
            best.setdefault(float(values[case]), int(case))
        return dict(sorted(best.items()))


def rank(rig: Rig, cases: Cases, results: CaseResults, *, drive: int) -> Ranking:
    """Rank cases of a rig by the median; those with too few ERAs for the drive are skipped."""
    medians = results.statistics[:, drive, MEDIAN]
    ranked = np.flatnonzero(~np.isnan(medians))
    falling = ranked[np.argsort(-medians[ranked], kind="stable")]
    # Cases equal by symmetry, each nearly as good as the one before, stay in their order.
    steps = medians[falling[1:]] < (1 - EQUAL) * medians[falling[:-1]]
    groups = np.concatenate([[0], np.cumsum(steps)])[: len(falling)]
    order = falling[np.lexsort((falling, groups))]
    return Ranking(cases, results, drive, order, are_supported(rig, cases))


def are_supported(rig: Rig, cases: Cases) -> NDArray[np.bool_]:
    """Which cases have ERAs that support the plate, (n,)."""
    mounts = cases.mounts(rig.eras)
    at = cases.positions[cases.places]  # of VACANT any, without stiffness and mass
    loads = [[load.x, load.y, load.stiffness, load.mass] for load in rig.masses]
    attached = np.concatenate([at, mounts[:, :, [0, 2]]], axis=2)
    carried = np.array(loads, dtype=float).reshape(-1, 4)
    carried = np.broadcast_to(carried, (len(cases), *carried.shape))
    attached = np.concatenate([attached, carried], axis=1)
    lowest = rigid_body_frequencies_of(
        rig.plate, attached[..., :2], attached[..., 2], attached[..., 3]
    )[:, 0]
    return np.asarray(lowest >= MIN_RIGID_BODY_FREQUENCY)


def check_supported_cases(rig: Rig, cases: Cases) -> None:
    """Raise InputError if no case supports the plate, so that none could be recommended."""
    if not are_supported(rig, cases).any():
        raise InputError(
            f"none of {counted(len(cases), 'layout')} supports the plate; give the rig at least "
            "three ERAs, stiff enough, or allow more --layouts"
        )


def era_counts(cases: Cases) -> IntArray:
    """How many ERAs each case has, (n,)."""
    return np.asarray((cases.places != VACANT).sum(axis=1))
