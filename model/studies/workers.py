"""Workers that solve the chunks of a study: this process, others beside it, or a Dask cluster.

Each is a function of the problem and the numbered chunks that yields numbers with their results in
the order in which they are done.
"""

import re
from collections.abc import Callable, Iterator, Mapping
from typing import TypeAlias

from model import processes
from model.errors import InputError
from model.structure.actuator import Era
from model.studies.cases import Cases
from model.studies.receptances import Receptances
from model.studies.solve import CaseResults, StudyProblem, solve_cases
from model.version import code_version
from model.vibration.activation import activation_sets

Solved: TypeAlias = Iterator[tuple[int, CaseResults]]
Workers: TypeAlias = Callable[[StudyProblem, Mapping[int, Cases]], Solved]
_Shared: TypeAlias = tuple[Receptances, tuple[Era, ...]]

_CONNECT_TIMEOUT = 10.0  # s

# Amplitudes, of sets of ERAs at points and frequencies, that take two seconds, twice as long as a
# process needs to start.
_WORTH_A_PROCESS = 1_500_000_000

# Dask takes long to refuse what is not an address.
_ADDRESS = re.compile(r"(tcp|tls)://[\w.\-\[\]:]+:\d{1,5}")


def useful_processes(problem: StudyProblem, cases: Cases, available: int) -> int:
    """How many of the available processes are worth their start: a small study has one."""
    eras = cases.places.shape[1]
    size = len(problem.frequencies) * len(problem.points) * len(activation_sets(eras))
    return max(1, min(available, size * len(cases) // _WORTH_A_PROCESS))


def on_processes(count: int) -> Workers:
    """Processes on this machine, each with one thread for linear algebra; one is this process."""

    def solve(problem: StudyProblem, chunks: Mapping[int, Cases]) -> Solved:
        shared = problem.solve(), problem.rig.eras
        yield from processes.on_processes(count, _solve_chunk, shared, chunks)

    return solve


def on_cluster(address: str) -> Workers:
    """The workers of a Dask scheduler, for example tcp://192.168.1.5:8786.

    A chunk whose worker is lost is solved again. Raises InputError for what is not an address;
    when used, where no scheduler answers, it has no workers, or one runs other code.
    """
    if not _ADDRESS.fullmatch(address):
        raise InputError(
            f"--cluster must be the address that `dask scheduler` prints, for example "
            f"tcp://192.168.1.5:8786, got {address[:60]!r}"
        )

    def solve(problem: StudyProblem, chunks: Mapping[int, Cases]) -> Solved:
        try:
            from distributed import Client, KilledWorker, as_completed
        except ImportError as error:
            raise InputError(
                "--cluster needs Dask, which is not installed; install it in a checkout with  "
                "pip install -e '.[cluster]'"
            ) from error
        try:
            # Dask has no type annotations.
            client = Client(address, timeout=_CONNECT_TIMEOUT, set_as_default=False)  # type: ignore[no-untyped-call]
        except (OSError, ValueError) as error:
            raise InputError(
                f"no Dask scheduler answers at {address} ({error}); start one with `dask "
                "scheduler`, and on every machine `dask worker` with the address it prints"
            ) from error
        with client:
            if not client.scheduler_info(n_workers=-1)["workers"]:
                raise InputError(
                    f"the Dask scheduler at {address} has no workers; start `dask worker {address}`"
                )
            version = code_version()
            # Solved on the cluster, so that the scheduler can repeat it if its worker is lost.
            shared = client.submit(_solve_plate, version, problem, pure=False)
            numbers = {
                client.submit(_solve_on_cluster, version, shared, cases, pure=False): n
                for n, cases in chunks.items()
            }
            try:
                for future in as_completed(numbers, loop=client.loop):  # type: ignore[no-untyped-call]
                    results: CaseResults = future.result()
                    yield numbers.pop(future), results
            except KilledWorker as error:
                raise InputError(
                    f"workers of the cluster died repeatedly over one chunk ({error}); perhaps "
                    "they are short of memory"
                ) from error

    return solve


def _solve_chunk(shared: _Shared, cases: Cases) -> CaseResults:
    receptances, eras = shared
    return solve_cases(receptances, eras, cases)


def _solve_plate(version: str, problem: StudyProblem) -> _Shared:
    _check_code(version)
    return problem.solve(), problem.rig.eras


def _solve_on_cluster(version: str, shared: _Shared, cases: Cases) -> CaseResults:
    _check_code(version)
    return _solve_chunk(shared, cases)


def _check_code(version: str) -> None:
    """Raise InputError on a machine that runs other code than the study was made by."""
    if version != code_version():
        raise InputError(
            f"all machines of a cluster must run the same era-haptics, got {code_version()} on a "
            f"worker and {version} here; install the same on every machine"
        )
