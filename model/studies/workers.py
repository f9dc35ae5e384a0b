"""Who solves the chunks of a study: this process, others beside it, or a Dask cluster.

Each is a function that takes the problem and the chunks by their numbers, and yields every number
with its results as soon as they are there, in any order.
"""

import logging
import multiprocessing
import os
import signal
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from typing import TypeAlias

from model.actuator import Era
from model.errors import InputError
from model.studies.cases import Cases
from model.studies.receptances import Receptances
from model.studies.solve import CaseResults, StudyProblem, solve_cases

_logger = logging.getLogger(__name__)

Solved: TypeAlias = Iterator[tuple[int, CaseResults]]
Workers: TypeAlias = Callable[[StudyProblem, Mapping[int, Cases]], Solved]

# A pool whose processes die again and again is out of memory, not out of luck.
_MOST_POOLS = 4

_THREAD_COUNTS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")

_Shared: TypeAlias = tuple[Receptances, tuple[Era, ...]]

_shared: _Shared  # in a worker process: what all its chunks need


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
        for variable in _THREAD_COUNTS:
            os.environ.setdefault(variable, "1")  # read by numpy when a new process loads it
        shared = (problem.solve(), problem.rig.eras)
        pending = dict(chunks)
        for _ in range(_MOST_POOLS):
            try:
                for number, results in _solve_in_pool(count, shared, pending):
                    del pending[number]
                    yield number, results
                return
            except BrokenProcessPool:
                _logger.warning("a worker process died; starting anew with what is left")
        raise InputError(
            f"worker processes died {_MOST_POOLS} times; perhaps memory is short: try fewer workers"
        )

    return solve


def _solve_in_pool(count: int, shared: _Shared, chunks: Mapping[int, Cases]) -> Solved:
    pool = ProcessPoolExecutor(
        min(count, len(chunks)) or 1,
        mp_context=multiprocessing.get_context("spawn"),
        initializer=_begin,
        initargs=(shared,),
    )
    try:
        with _interrupts_held_back():
            numbers = {pool.submit(_solve, cases): number for number, cases in chunks.items()}
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


def _begin(shared: _Shared) -> None:
    """Take what all chunks need, once; leave Ctrl-C to the process that started this one."""
    global _shared
    _shared = shared
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _solve(cases: Cases) -> CaseResults:
    receptances, eras = _shared
    return solve_cases(receptances, eras, cases)
