"""A study on a Dask cluster."""

import re
from collections.abc import Mapping

from model.errors import InputError
from model.structure.actuator import Era
from model.studies.cases import Cases
from model.studies.receptances import Receptances
from model.studies.solve import CaseResults, StudyProblem, solve_cases
from model.studies.workers import Solved, Workers
from model.version import code_version

_CONNECT_TIMEOUT = 10.0  # s

# Dask itself hangs for a while over what is no address.
_ADDRESS = re.compile(r"(tcp|tls)://[\w.\-\[\]:]+:\d{1,5}")


def on_cluster(address: str) -> Workers:
    """The workers of a Dask scheduler, for example tcp://192.168.1.5:8786.

    A worker that is lost in the middle costs its chunks once more. Raises InputError for what is no
    address; when used, where no scheduler answers, it has no workers, or one runs other code.
    """
    if not _ADDRESS.fullmatch(address):
        raise InputError(
            f"--cluster {address[:60]!r} is no address of a Dask scheduler; write the one that "
            "`dask scheduler` prints, for example tcp://192.168.1.5:8786"
        )

    def solve(problem: StudyProblem, chunks: Mapping[int, Cases]) -> Solved:
        try:
            from distributed import Client, KilledWorker, as_completed
        except ImportError as error:
            raise InputError(
                "--cluster needs Dask, which is not installed: pip install 'era-haptics[cluster]'"
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
            # Solved on the cluster and not sent there: if every worker that holds the answer is
            # lost, the scheduler has it solved once more.
            receptances = client.submit(_solve_plate, problem, pure=False)
            eras, version = problem.rig.eras, problem.code_version
            numbers = {
                client.submit(_solve_chunk, version, receptances, eras, cases, pure=False): number
                for number, cases in chunks.items()
            }
            try:
                for future in as_completed(numbers, loop=client.loop):  # type: ignore[no-untyped-call]
                    results: CaseResults = future.result()
                    yield numbers.pop(future), results
            except KilledWorker as error:
                raise InputError(
                    f"workers of the cluster died again and again over one chunk ({error}); "
                    "perhaps their memory is short"
                ) from error

    return solve


def _solve_plate(problem: StudyProblem) -> Receptances:
    _check_code(problem.code_version)
    return problem.solve()


def _solve_chunk(
    version: str, receptances: Receptances, eras: tuple[Era, ...], cases: Cases
) -> CaseResults:
    _check_code(version)
    return solve_cases(receptances, eras, cases)


def _check_code(version: str) -> None:
    """Raise InputError on a machine that runs other code than the study was made by."""
    if version != code_version():
        raise InputError(
            f"a worker of the cluster runs other code than this machine ({code_version()} and "
            f"{version}); install the same era-haptics on every machine"
        )
