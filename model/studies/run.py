"""Running a study: chunks from the cache or from workers, put together in order."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from model.studies.cache import ResultCache
from model.studies.cases import Cases
from model.studies.solve import CaseResults, StudyProblem
from model.studies.workers import Workers

# About a sixth of a second of work: little is lost when interrupted, and little time goes into
# handing chunks over, which takes a cluster's scheduler some milliseconds each.
CHUNK = 256


@dataclass(frozen=True)
class StudyRun:
    """Results of all cases in their order, and how many came from the cache."""

    results: CaseResults
    solved_count: int
    cached_count: int


def run_study(
    problem: StudyProblem,
    cases: Cases,
    *,
    workers: Workers,
    cache: ResultCache,
    progress: Callable[[int], None] = lambda count: None,
) -> StudyRun:
    """Solve all cases that the cache does not hold, and keep each chunk as soon as it is solved.

    progress: called with how many more cases are done. An exception, Ctrl-C among them, leaves the
    chunks that are done in the cache.
    """
    chunks = {
        number: cases.part(start, start + CHUNK)
        for number, start in enumerate(range(0, len(cases), CHUNK))
    }
    done: dict[int, CaseResults] = {}
    for number, part in chunks.items():
        kept = cache.load(part)
        if kept is not None:
            done[number] = kept
            progress(len(part))
    cached_count = sum(len(chunks[number]) for number in done)
    missing = {number: part for number, part in chunks.items() if number not in done}
    for number, results in workers(problem, missing) if missing else ():
        cache.store(chunks[number], results)
        done[number] = results
        progress(len(chunks[number]))
    in_order = [done[number] for number in chunks]
    return StudyRun(
        CaseResults(
            np.concatenate([results.statistics for results in in_order]),
            np.concatenate([results.active for results in in_order]),
        ),
        solved_count=len(cases) - cached_count,
        cached_count=cached_count,
    )
