"""Work shared out among processes of this machine, each with one thread for linear algebra."""

import logging
import multiprocessing
import os
import signal
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from typing import Any, TypeVar

from model.errors import InputError

_logger = logging.getLogger(__name__)

# A pool whose processes die again and again is out of memory, not out of luck.
_MOST_POOLS = 4

_THREAD_COUNTS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")

Shared = TypeVar("Shared")
Task = TypeVar("Task")
Result = TypeVar("Result")

_in_worker: tuple[Callable[[Any, Any], Any], Any]  # in a worker process: what its tasks need


def on_processes(
    count: int,
    solve: Callable[[Shared, Task], Result],
    shared: Shared,
    tasks: Mapping[int, Task],
) -> Iterator[tuple[int, Result]]:
    """Every task's number with its result as soon as it is there, in any order.

    solve: a function of a module; shared goes to each process once. A process that dies is
    replaced, and its task solved again; InputError if that does not help.
    """
    for variable in _THREAD_COUNTS:
        os.environ.setdefault(variable, "1")  # read by numpy when a new process loads it
    pending = dict(tasks)
    for _ in range(_MOST_POOLS):
        try:
            for number, result in _solve_in_pool(count, solve, shared, pending):
                del pending[number]
                yield number, result
            return
        except BrokenProcessPool:
            _logger.warning("a worker process died; starting anew with what is left")
    raise InputError(
        f"worker processes died {_MOST_POOLS} times; perhaps memory is short: give fewer --workers"
    )


def _solve_in_pool(
    count: int,
    solve: Callable[[Shared, Task], Result],
    shared: Shared,
    tasks: Mapping[int, Task],
) -> Iterator[tuple[int, Result]]:
    pool = ProcessPoolExecutor(
        min(count, len(tasks)) or 1,
        mp_context=multiprocessing.get_context("spawn"),
        initializer=_begin,
        initargs=(solve, shared),
    )
    try:
        with _interrupts_held_back():
            numbers = {pool.submit(_run, task): number for number, task in tasks.items()}
        for future in as_completed(numbers):
            yield numbers[future], future.result()
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


@contextmanager
def _interrupts_held_back() -> Iterator[None]:
    """Start processes that Ctrl-C does not reach, not even while they are still loading.

    They inherit what is blocked here; a Ctrl-C meanwhile arrives afterwards.
    """
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _begin(solve: Callable[[Any, Any], Any], shared: Any) -> None:
    """Take what all tasks need, once; leave Ctrl-C to the process that started this one."""
    global _in_worker
    _in_worker = solve, shared
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _run(task: Any) -> Any:
    solve, shared = _in_worker
    return solve(shared, task)
