"""Running a study: finished cases from its file, the others from worker processes."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from model.studies.cases import Cases
from model.studies.finished import FinishedCases
from model.studies.solve import CaseResults, StudyProblem, empty_results
from model.studies.workers import Workers

# About half a second of work; to hand one over takes a cluster's scheduler milliseconds.
CHUNK = 128


@dataclass(frozen=True)
class StudyRun:
    """Results of all cases in their order, and how many of them were finished before."""

    results: CaseResults
    solved_count: int
    cached_count: int


def run_study(
    problem: StudyProblem,
    cases: Cases,
    *,
    workers: Workers,
    finished: FinishedCases | None = None,
    progress: Callable[[int], None] = lambda count: None,
) -> StudyRun:
    """Solve all cases that are not finished, in chunks that workers share.

    finished: None if nothing is kept; progress: called with the number of further cases done.
    After an exception, Ctrl-C included, the chunks that are done are saved.
    """
    done, results = np.zeros(len(cases), dtype=bool), empty_results(len(cases))
    if finished is not None:
        done, results = finished.find(cases)
    cached_count = int(done.sum())
    progress(cached_count)
    missing = np.flatnonzero(~done)
    parts = dict(enumerate(missing[at : at + CHUNK] for at in range(0, len(missing), CHUNK)))
    chunks = {number: cases.take(part) for number, part in parts.items()}
    try:
        for number, solved in workers(problem, chunks) if chunks else ():
            results.expected_db[parts[number]] = solved.expected_db
            results.statistics[parts[number]] = solved.statistics
            results.active[parts[number]] = solved.active
            if finished is not None:
                finished.add(chunks[number], solved)
            progress(len(parts[number]))
    finally:
        if finished is not None:
            finished.save()
    return StudyRun(results, len(missing), cached_count)
