"""Workers that solve the chunks of a study: this process, others beside it, or a Dask cluster.

Each is a function of the problem and the numbered chunks that yields numbers with their results in
the order in which they are done.
"""

from collections.abc import Callable, Iterator, Mapping
from typing import TypeAlias

from model import processes
from model.cluster import Cluster
from model.structure.actuator import Era
from model.studies.cases import Cases
from model.studies.receptances import Receptances
from model.studies.solve import CaseResults, StudyProblem, solve_cases
from model.vibration.activation import activation_sets

Solved: TypeAlias = Iterator[tuple[int, CaseResults]]
Workers: TypeAlias = Callable[[StudyProblem, Mapping[int, Cases]], Solved]
_Shared: TypeAlias = tuple[Receptances, tuple[Era, ...]]

# Amplitudes, of sets of ERAs at points and frequencies, that take two seconds, twice as long as a
# process needs to start.
_WORTH_A_PROCESS = 1_500_000_000


def useful_processes(problem: StudyProblem, cases: Cases, available: int) -> int:
    """How many of the available processes are worth their start: a small study has one."""
    eras = cases.places.shape[1]
    size = len(problem.frequencies) * len(problem.points) * len(activation_sets(eras))
    return max(1, min(available, size * len(cases) // _WORTH_A_PROCESS))


def on_processes(count: int) -> Workers:
    """Processes on this machine, each with one thread for linear algebra; one is this process."""

    def solve(problem: StudyProblem, chunks: Mapping[int, Cases]) -> Solved:
        yield from processes.on_processes(count, _solve_chunk, _solve_plate(problem), chunks)

    return solve


def on_cluster(address: str) -> Workers:
    """The workers of a Dask scheduler, for example tcp://192.168.1.5:8786.

    Raises InputError for what is not an address; further, when used: `model.cluster`.
    """
    cluster = Cluster(address)

    def solve(problem: StudyProblem, chunks: Mapping[int, Cases]) -> Solved:
        yield from cluster.solve(_solve_plate, problem, _solve_chunk, chunks)

    return solve


def _solve_chunk(shared: _Shared, cases: Cases) -> CaseResults:
    receptances, eras = shared
    return solve_cases(receptances, eras, cases)


def _solve_plate(problem: StudyProblem) -> _Shared:
    return problem.solve(), problem.rig.eras
