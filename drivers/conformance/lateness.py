"""Delays of this program."""

import asyncio
import math
from collections import deque

from drivers import clock

_PERIOD = 0.002  # s

STALL = 0.004
"""Lateness [s] from which an attempt counts as disturbed."""


class Lateness:
    """Measures the lateness of the running event loop while its context lasts.

    worst [s]: the largest delay of a timer.
    """

    def __init__(self) -> None:
        self.worst = 0.0
        self._delays: deque[tuple[float, float]] = deque()
        self._timer: asyncio.TimerHandle | None = None
        self._due = 0.0

    def __enter__(self) -> "Lateness":
        self._schedule()
        return self

    def __exit__(self, *_: object) -> None:
        if self._timer is not None:
            self._timer.cancel()
        self._note()

    def since(self, time: float) -> float:
        """How long [s] this program did not run since a time, in stalls."""
        self._note()
        self._due = max(self._due, clock.now())
        return math.fsum(delay for at, delay in self._delays if at >= time)

    def _schedule(self) -> None:
        self._due = clock.now() + _PERIOD
        self._timer = asyncio.get_running_loop().call_at(self._due, self._fired)

    def _fired(self) -> None:
        self._note()
        self._schedule()

    def _note(self) -> None:
        now = clock.now()
        late = now - self._due
        self.worst = max(self.worst, late)
        if late > STALL:
            self._delays.append((now, late))
