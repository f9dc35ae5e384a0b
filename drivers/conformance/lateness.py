"""Delays of this program, and of an emulated amplifier that shares its processors."""

import asyncio
import contextlib
import math
import os
from collections import deque
from pathlib import Path

from drivers import clock
from drivers.conformance.stolen_time import StolenTime

_PERIOD = 0.002  # s
_LISTED = 25  # periods between two looks for new threads

STALL = 0.004
"""Lateness [s] from which an attempt counts as disturbed."""


class ProcessorWaits:
    """How long the threads of a process were ready to run and did not, by Linux's scheduler.

    process: its number on this machine; None: of no process. Used as a context, since it keeps the
    statistics of its threads open: they are read so often that opening them each time would delay
    what is measured.
    """

    def __init__(self, process: int | None) -> None:
        self._tasks = Path(f"/proc/{process}/task") if process is not None else None
        self._open: dict[str, int] = {}
        self._waited: dict[str, int] = {}
        self._reads = 0

    def __enter__(self) -> "ProcessorWaits":
        return self

    def __exit__(self, *_: object) -> None:
        for task in list(self._open):
            self._close(task)

    def total(self) -> float:
        """Return the time [s] so far, also of threads that have ended."""
        if self._reads % _LISTED == 0:
            self._list()
        self._reads += 1
        for task, descriptor in list(self._open.items()):
            try:
                self._waited[task] = int(os.pread(descriptor, 64, 0).split()[1])
            except (OSError, IndexError):  # a thread that has just ended
                self._close(task)
        return sum(self._waited.values()) * 1e-9

    def _list(self) -> None:
        """Open the statistics of threads that are new."""
        if self._tasks is None:
            return
        with contextlib.suppress(OSError):  # the process, or the thread, has ended
            for task in self._tasks.iterdir():
                if task.name not in self._waited:
                    descriptor = os.open(task / "schedstat", os.O_RDONLY | os.O_CLOEXEC)
                    self._open[task.name], self._waited[task.name] = descriptor, 0

    def _close(self, task: str) -> None:
        os.close(self._open.pop(task))


class Lateness:
    """Measures the lateness of the running event loop while its context lasts.

    worst [s]: the largest delay of a timer.
    process: number of a process on this machine that is the amplifier; its threads are late while
    they wait for a processor, or one is taken from this machine.
    """

    def __init__(self, process: int | None = None) -> None:
        self._waits = ProcessorWaits(process)
        self._stolen = None if process is None else StolenTime()
        self._waited = 0.0
        self.worst = 0.0
        self._delays: deque[tuple[float, float]] = deque()
        self._timer: asyncio.TimerHandle | None = None
        self._due = 0.0

    def __enter__(self) -> "Lateness":
        self._waited = self._all_waits()
        self._schedule()
        return self

    def __exit__(self, *_: object) -> None:
        if self._timer is not None:
            self._timer.cancel()
        with self._waits, self._stolen or contextlib.nullcontext():
            self._note()

    def since(self, time: float) -> float:
        """How long [s] an amplifier on this machine may not have run since a time, at most.

        That is what its process waited; without one, what this program was late.
        """
        self._note()
        self._due = max(self._due, clock.now())
        return math.fsum(delay for at, delay in self._delays if at >= time)

    def _schedule(self) -> None:
        self._due = clock.now() + _PERIOD
        self._timer = asyncio.get_running_loop().call_at(self._due, self._fired)

    def _fired(self) -> None:
        self._note()
        self._schedule()

    def _all_waits(self) -> float:
        return self._waits.total() + (0.0 if self._stolen is None else self._stolen.total())

    def _note(self) -> None:
        before, self._waited = self._waited, self._all_waits()
        now = clock.now()
        waited, late = self._waited - before, now - self._due
        self.worst = max(self.worst, late, waited)
        if waited > 0 or late > STALL:
            self._delays.append((now, max(waited, late if late > STALL else 0.0)))
