"""Tasks on processes of this machine, each with one thread for linear algebra."""

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from typing import Any, TypeVar

from model.errors import InputError

_THREAD_COUNTS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")

Shared = TypeVar("Shared")
Task = TypeVar("Task")
Result = TypeVar("Result")

_in_worker: tuple[Callable[[Any, Any], Any], Any]  # set by _start_worker


def on_processes(
    count: int,
    solve: Callable[[Shared, Task], Result],
    shared: Shared,
    tasks: Mapping[int, Task],
) -> Iterator[tuple[int, Result]]:
    """Yield numbers of tasks with their results in the order in which they are done.

    count: of processes, 1 for this one; solve: a function of a module; shared: its first argument,
    sent to each process once. Raises InputError if a process dies.
    """
    if count == 1:
        yield from ((number, solve(shared, task)) for number, task in tasks.items())
        return
    for variable in _THREAD_COUNTS:
        os.environ.setdefault(variable, "1")  # read by numpy when a new process loads it
    pool = ProcessPoolExecutor(
        min(count, len(tasks)) or 1,
        mp_context=multiprocessing.get_context("spawn"),
        initializer=_start_worker,
        initargs=(solve, shared),
    )
    try:
        with _interrupts_blocked():
            numbers = {pool.submit(_run, task): number for number, task in tasks.items()}
        for future in as_completed(numbers):
            yield numbers[future], future.result()
    except BrokenProcessPool:
        raise InputError(
            "a worker process died, perhaps short of memory; use fewer of them (--workers)"
        ) from None
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


@contextmanager
def _interrupts_blocked() -> Iterator[None]:
    """Block SIGINT while processes start: they inherit the mask, also while they load.

    A Ctrl-C in the meantime is delivered afterwards.
    """
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _start_worker(solve: Callable[[Any, Any], Any], shared: Any) -> None:
    """Keep what all tasks need; ignore Ctrl-C, which the parent process handles; end with it."""
    global _in_worker
    _in_worker = solve, shared
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """End this process when its parent has; a pool's worker waits for tasks for ever else."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _run(task: Any) -> Any:
    solve, shared = _in_worker
    return solve(shared, task)
