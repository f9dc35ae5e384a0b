"""Judging the finalists of a study by the answers of their localization tables."""

from collections.abc import Callable
from dataclasses import replace

from model.arrays import FloatArray
from model.cluster import Cluster
from model.design.contacts import ContactRule
from model.design.judge import JUDGED_SEED, JUDGED_SETS, Judged, judge
from model.processes import on_processes
from model.rig.rig import Rig
from model.studies.ranking import Ranking, Scored, era_counts, rank
from model.studies.solve import SETS_SEED

DEFAULT_FINALISTS = 5
"""Cases that lead by expected contrast and are judged."""


def judge_finalists(
    rig: Rig,
    scored: Scored,
    *,
    contacts: ContactRule,
    finalists: int = DEFAULT_FINALISTS,
    workers: int = 1,
    cluster: Cluster | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Ranking:
    """Judge the finalists of a rig's study on fresh contact sets, and rank all cases.

    The contact sets are those by which `era design` judges from its default seed. cluster: in place
    of so many workers on this machine; progress: called with the number of finalists done and the
    total. Raises InputError.
    """
    groups = (era_counts(scored.cases), scored.cases.stiffness_factors)
    chosen = scored.finalists(finalists, groups=groups)
    sets = contacts.sets(JUDGED_SETS, seed=SETS_SEED + JUDGED_SEED)
    rigs = {
        case: replace(rig, eras=scored.cases.eras_of(case, rig.eras), wiring={}, amplifiers={})
        for case in chosen
    }
    judged: dict[int, Judged] = {}
    progress(0, len(rigs))
    for case, answers in (
        on_processes(min(workers, len(rigs)), _judge, sets, rigs)
        if cluster is None
        else cluster.solve(list, sets, _judge, rigs)
    ):
        judged[case] = answers
        progress(len(judged), len(rigs))
    return rank(scored, {case: judged[case] for case in chosen}, finalists=finalists)


def _judge(sets: list[FloatArray], rig: Rig) -> Judged:
    return judge(rig, sets)
