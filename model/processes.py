"""Parallel tasks with progress: on processes of this machine, or on workers of a Dask scheduler.

Each process has one thread for linear algebra. Workers must run the same code as this machine.
"""

import multiprocessing
import os
import re
import signal
import threading
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection
from typing import Any, TypeAlias, TypeVar

from model.caching import code_version
from model.errors import InputError, shown

_THREAD_COUNTS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")

Shared = TypeVar("Shared")
Task = TypeVar("Task")
_Result = TypeVar("_Result")

_in_worker: tuple[Callable[[Any, Any], Any], Any]  # set by _start_worker


def on_processes(
    count: int,
    solve: Callable[[Shared, Task], _Result],
    shared: Shared,
    tasks: Mapping[int, Task],
) -> Iterator[tuple[int, _Result]]:
    """Yield the numbers and results of tasks, in the order in which they finish.

    count: number of processes, 1 for this one; solve: a module-level function; shared: its first
    argument, sent to each process once. The processes end immediately if the caller stops early,
    for example on Ctrl-C. Raises InputError if a process dies.
    """
    if count == 1:
        yield from ((number, solve(shared, task)) for number, task in tasks.items())
        return
    for variable in _THREAD_COUNTS:
        os.environ.setdefault(variable, "1")  # read by numpy when a new process loads it
    context = multiprocessing.get_context("spawn")
    stop, stopper = context.Pipe(duplex=False)
    pool = ProcessPoolExecutor(
        min(count, len(tasks)) or 1,
        mp_context=context,
        initializer=_start_worker,
        initargs=(solve, shared, stop),
    )
    is_done = False
    try:
        with _interrupts_blocked():
            numbers = {pool.submit(_run, task): number for number, task in tasks.items()}
        for future in as_completed(numbers):
            yield numbers[future], future.result()
        is_done = True
    except BrokenProcessPool:
        raise InputError(
            "a worker process died, perhaps for lack of memory; use fewer workers (--workers)"
        ) from None
    finally:
        if not is_done:
            stopper.send_bytes(b"stop")  # not read by any process, so that all receive it
        pool.shutdown(wait=True, cancel_futures=True)
        stopper.close()
        stop.close()


@contextmanager
def _interrupts_blocked() -> Iterator[None]:
    """Block SIGINT while processes start: they inherit the mask, also while they load.

    A Ctrl-C in the meantime is delivered afterwards.
    """
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    former_mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, former_mask)


def _start_worker(solve: Callable[[Any, Any], Any], shared: Any, stop: Connection) -> None:
    """Store the data of all tasks; ignore Ctrl-C, which the parent handles; end with the parent."""
    global _in_worker
    _in_worker = solve, shared
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    threading.Thread(target=_end_on, args=(stop,), daemon=True).start()


def _end_on(stop: Connection) -> None:
    """End this process in the middle of its task when the parent stops the work."""
    with suppress(OSError):
        stop.poll(None)
    os._exit(1)


def _end_with_parent() -> None:
    """End this process when its parent ends; otherwise a pool's worker waits for tasks forever."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _run(task: Any) -> Any:
    solve, shared = _in_worker
    return solve(shared, task)


Progress: TypeAlias = Callable[[int, int], None]
"""Called with the number of tasks, positions or stages done, and the total."""


def unseen(done: int, total: int) -> None:
    """Ignore progress."""


def check_progress(progress: object) -> None:
    """Raise InputError for a value that is not callable."""
    if not callable(progress):
        raise InputError(f"progress must be a function of done and total, got {shown(progress)}")


SCHEDULER_TIMEOUT = 10.0  # s

# Dask takes long to reject an invalid address.
_ADDRESS = re.compile(r"(tcp|tls)://[\w.\-\[\]:]+:\d{1,5}")


def on_cluster(
    address: str,
    solve: Callable[[Shared, Task], _Result],
    shared: Shared,
    tasks: Mapping[int, Task],
) -> Iterator[tuple[int, _Result]]:
    """Yield the numbers and results of tasks, in the order in which they finish.

    address: of a scheduler, for example tcp://192.168.1.5:8786; solve: a function of a module;
    shared: its first argument. A task whose worker is lost is solved again. Raises InputError if
    no scheduler replies, it has no workers, or a worker runs other code.
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
        client = Client(address, timeout=SCHEDULER_TIMEOUT, set_as_default=False)  # type: ignore[no-untyped-call]
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
        held = client.submit(run_same_code, version, _itself, shared, pure=False)
        numbers = {
            client.submit(run_same_code, version, solve, held, task, pure=False): n
            for n, task in tasks.items()
        }
        try:
            for future in as_completed(numbers, loop=client.loop):  # type: ignore[no-untyped-call]
                result: _Result = future.result()
                yield numbers.pop(future), result
        except KilledWorker as error:
            raise InputError(
                f"workers of the cluster died repeatedly over one task ({error}); perhaps "
                "they are short of memory"
            ) from error


def _itself(shared: Shared) -> Shared:
    return shared


def run_same_code(version: str, function: Callable[..., Any], *arguments: Any) -> Any:
    """Call a function on a machine that must run the code of this version."""
    if version != code_version():
        raise InputError(
            f"all machines of a cluster must run the same era-haptics, got {code_version()} on a "
            f"worker and {version} here; install the same on every machine"
        )
    return function(*arguments)
