"""Workers that solve the chunks of a study: this process, others beside it, or a Dask cluster.

Each is a function of the problem and the numbered chunks that yields numbers with their results in
the order in which they are done.
"""

from collections.abc import Callable, Iterator, Mapping
from typing import TypeAlias

from model import processes
from model.cluster import Cluster
from model.studies.cases import Cases
from model.studies.solve import CaseResults, SolvedStudy, StudyProblem, solve_cases
from model.vibration.activation import activation_sets

Solved: TypeAlias = Iterator[tuple[int, CaseResults]]
Workers: TypeAlias = Callable[[StudyProblem, Mapping[int, Cases]], Solved]

_WORTH_A_PROCESS = 2.0  # s, twice as long as a process needs to start
_AMPLITUDE_TIME = 1.3e-9  # s; of a set of ERAs at a point and a frequency
_SCORE_TIME = 6e-3  # s; of a layout of four ERAs


def useful_processes(problem: StudyProblem, cases: Cases, available: int) -> int:
    """How many of the available processes are worth their start: a small study has one."""
    eras = cases.places.shape[1]
    size = len(problem.frequencies) * len(problem.points) * len(activation_sets(eras))
    time = len(cases) * (size * _AMPLITUDE_TIME + _SCORE_TIME)
    return max(1, min(available, int(time / _WORTH_A_PROCESS)))


def on_processes(count: int) -> Workers:
    """Processes on this machine, each with one thread for linear algebra; one is this process."""

    def solve(problem: StudyProblem, chunks: Mapping[int, Cases]) -> Solved:
        yield from processes.on_processes(count, solve_cases, problem.solve(), chunks)

    return solve


def on_cluster(cluster: Cluster) -> Workers:
    """The workers of a Dask scheduler. Raises InputError when used: `model.cluster`."""

    def solve(problem: StudyProblem, chunks: Mapping[int, Cases]) -> Solved:
        yield from cluster.solve(_solve_plate, problem, solve_cases, chunks)

    return solve


def _solve_plate(problem: StudyProblem) -> SolvedStudy:
    return problem.solve()
