"""Ranking of the cases of a study by robust felt contrast, and the recommended one."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from model.arrays import FloatArray, IntArray
from model.choice import best_by, best_first, ranked_by
from model.design.judge import Judged
from model.rig.rig import Rig
from model.studies.cases import OWN, VACANT, Cases
from model.studies.solve import CaseResults
from model.studies.supported import Support, support_of
from model.vibration.activation import MEDIAN

GOOD_ENOUGH_DB = 1.0
"""Contrast [dB] that fewer or softer ERAs may be behind the best and still be recommended."""


@dataclass(frozen=True, eq=False)
class Scored:
    """Cases in the order of their expected contrast; those that do not support the plate last.

    drive: number in DRIVES, of loudness; order (n,): of all cases.
    """

    cases: Cases
    results: CaseResults
    drive: int
    support: Support
    order: IntArray

    @property
    def supported_order(self) -> IntArray:
        """The cases that support the plate, in order."""
        return self.order[: int(self.support.is_supported.sum())]

    @property
    def own(self) -> int | None:
        """The rig's own layout, if it is among the cases."""
        for case in self.order:
            if self.cases.names[case] == OWN and self.cases.stiffness_factors[case] == 1:
                return int(case)
        return None

    @property
    def middle(self) -> int:
        """The case in the middle of those that support the plate."""
        return int(self.supported_order[len(self.supported_order) // 2])

    @property
    def worst(self) -> int:
        """The last case that supports the plate."""
        return int(self.supported_order[-1])

    def finalists(self, count: int, *, groups: Iterable[FloatArray | IntArray] = ()) -> list[int]:
        """Cases to be judged by their tables' answers, in order.

        The first of the order, so many; the first of each value of each group (n,), such as the
        number of ERAs; the rig's own, the middle and the worst. All of them support the plate.
        """
        chosen = {int(case) for case in self.supported_order[:count]}
        for values in groups:
            chosen |= set(first_of(self.supported_order, values).values())
        if self.own is not None and self.support.is_supported[self.own]:
            chosen.add(self.own)
        chosen |= {self.middle, self.worst}
        return [int(case) for case in self.order if int(case) in chosen]


def score_order(
    rig: Rig, cases: Cases, results: CaseResults, *, drive: int, lowest: float
) -> Scored:
    """Order cases of a rig by expected contrast; those that do not support it by loudness.

    lowest [Hz]: least rigid-body frequency of a case that supports the plate.
    """
    support = support_of(rig, cases, lowest=lowest)
    medians = np.nan_to_num(results.statistics[:, drive, MEDIAN])
    values = np.where(support.is_supported, results.expected_db, medians)
    order = best_first(values)
    order = order[np.argsort(~support.is_supported[order], kind="stable")]
    return Scored(cases, results, drive, support, order)


@dataclass(frozen=True, eq=False)
class Ranking:
    """Cases by robust felt contrast, the best first.

    judged: answers of the finalists, by case; head: how many of them lead the order, by the mean
    contrast of their answers. The others follow by expected contrast.
    """

    scored: Scored
    judged: Mapping[int, Judged]
    order: IntArray
    head: int

    @property
    def cases(self) -> Cases:
        """The cases."""
        return self.scored.cases

    @property
    def results(self) -> CaseResults:
        """Results of the cases."""
        return self.scored.results

    @property
    def best(self) -> int:
        """The case of rank one."""
        return int(self.order[0])

    @property
    def recommended(self) -> int:
        """The judged case with fewest, then softest ERAs within GOOD_ENOUGH_DB of the best.

        In a study of placement that is the best.
        """
        counts, factors = era_counts(self.cases), self.cases.stiffness_factors
        enough = self.judged[self.best].mean_db - GOOD_ENOUGH_DB
        good = [case for case, answers in self.judged.items() if answers.mean_db >= enough]
        effort = {case: (counts[case], factors[case]) for case in good}
        least = min(effort.values())
        easiest = [case for case in good if effort[case] == least]
        return best_by(easiest, lambda case: self.judged[case].mean_db)

    def best_by(self, values: FloatArray | IntArray) -> dict[float, int]:
        """The best case for each distinct value (n,) of those that support the plate."""
        supported = self.scored.support.is_supported
        return first_of(self.order[supported[self.order]], values)


def rank(scored: Scored, judged: Mapping[int, Judged], *, finalists: int) -> Ranking:
    """Rank cases: judged ones first that are not behind the worst of the first finalists.

    judged: answers by case, those of the first finalists among them.
    """
    ranked = ranked_by([*judged], lambda case: judged[case].mean_db)
    last = max(ranked.index(int(case)) for case in scored.supported_order[:finalists])
    head = ranked[: last + 1]
    rest = scored.order[~np.isin(scored.order, head)]
    return Ranking(scored, judged, np.array([*head, *rest.tolist()]), len(head))


def first_of(order: IntArray, values: FloatArray | IntArray) -> dict[float, int]:
    """The first case of an order for each distinct value (n,); values ascending."""
    first: dict[float, int] = {}
    for case in order:
        first.setdefault(float(values[case]), int(case))
    return dict(sorted(first.items()))


def era_counts(cases: Cases) -> IntArray:
    """How many ERAs each case has, (n,)."""
    return np.asarray((cases.places != VACANT).sum(axis=1))
