"""Tasks on the workers of a Dask scheduler, which run the same code as this machine."""

import re
from collections.abc import Callable, Iterator, Mapping
from typing import Any, TypeVar

from model.arguments import shown
from model.errors import InputError
from model.version import code_version

_CONNECT_TIMEOUT = 10.0  # s

# Dask takes long to refuse what is not an address.
_ADDRESS = re.compile(r"(tcp|tls)://[\w.\-\[\]:]+:\d{1,5}")

Shared = TypeVar("Shared")
Task = TypeVar("Task")
Result = TypeVar("Result")


def on_cluster(
    address: str,
    solve: Callable[[Shared, Task], Result],
    shared: Shared,
    tasks: Mapping[int, Task],
) -> Iterator[tuple[int, Result]]:
    """Yield numbers of tasks with their results in the order in which they are done.

    address: of a scheduler, for example tcp://192.168.1.5:8786; solve: a function of a module;
    shared: its first argument. A task whose worker is lost is solved again. Raises InputError where
    no scheduler answers, it has no workers, or one runs other code.
    """
    if not _ADDRESS.fullmatch(str(address)):
        raise InputError(
            "--cluster must be the address that `dask scheduler` prints, for example "
            f"tcp://192.168.1.5:8786, got {shown(address)}"
        )
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
        # Held on the cluster, so that the scheduler can repeat it if its worker is lost.
        held = client.submit(_run_same_code, version, _itself, shared, pure=False)
        numbers = {
            client.submit(_run_same_code, version, solve, held, task, pure=False): n
            for n, task in tasks.items()
        }
        try:
            for future in as_completed(numbers, loop=client.loop):  # type: ignore[no-untyped-call]
                result: Result = future.result()
                yield numbers.pop(future), result
        except KilledWorker as error:
            raise InputError(
                f"workers of the cluster died repeatedly over one task ({error}); perhaps "
                "they are short of memory"
            ) from error


def _itself(shared: Shared) -> Shared:
    return shared


def _run_same_code(version: str, function: Callable[..., Any], *arguments: Any) -> Any:
    """Call a function on a machine that must run the code of this version."""
    if version != code_version():
        raise InputError(
            f"all machines of a cluster must run the same era-haptics, got {code_version()} on a "
            f"worker and {version} here; install the same on every machine"
        )
    return function(*arguments)
