"""Who solves the chunks of a study: this process, others beside it, or a Dask cluster.

Each is a function that takes the problem and the chunks by their numbers, and yields every number
with its results as soon as they are there, in any order.
"""

from collections.abc import Callable, Iterator, Mapping
from typing import TypeAlias

from model import processes
from model.structure.actuator import Era
from model.studies.cases import Cases
from model.studies.receptances import Receptances
from model.studies.solve import CaseResults, StudyProblem, solve_cases

Solved: TypeAlias = Iterator[tuple[int, CaseResults]]
Workers: TypeAlias = Callable[[StudyProblem, Mapping[int, Cases]], Solved]


def in_process(problem: StudyProblem, chunks: Mapping[int, Cases]) -> Solved:
    """One chunk after the other, here."""
    receptances = problem.solve()
    for number, cases in chunks.items():
        yield number, solve_cases(receptances, problem.rig.eras, cases)


def on_processes(count: int) -> Workers:
    """So many processes on this machine, each with one thread for linear algebra.

    A process that dies is replaced, and its chunk solved again.
    """

    def solve(problem: StudyProblem, chunks: Mapping[int, Cases]) -> Solved:
        yield from processes.on_processes(
            count, _solve, (problem.solve(), problem.rig.eras), chunks
        )

    return solve


def _solve(shared: tuple[Receptances, tuple[Era, ...]], cases: Cases) -> CaseResults:
    receptances, eras = shared
    return solve_cases(receptances, eras, cases)
