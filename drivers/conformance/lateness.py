"""Delays of this program: how late its event loop was, and how long replies took."""

import asyncio

from drivers import clock

_PERIOD = 0.002  # s

STALL = 0.004
"""Lateness [s] from which an attempt counts as disturbed."""


class Lateness:
    """Measures the lateness of the running event loop while its context lasts.

    worst [s]: the largest delay of a timer; total [s]: the sum of those that count as stalls.
    """

    def __init__(self) -> None:
        self.worst = 0.0
        self.total = 0.0
        self._timer: asyncio.TimerHandle | None = None
        self._due = 0.0

    def __enter__(self) -> "Lateness":
        self._schedule()
        return self

    def __exit__(self, *_: object) -> None:
        if self._timer is not None:
            self._timer.cancel()
        self._note()

    def _schedule(self) -> None:
        self._due = clock.now() + _PERIOD
        self._timer = asyncio.get_running_loop().call_at(self._due, self._fired)

    def _fired(self) -> None:
        self._note()
        self._schedule()

    def _note(self) -> None:
        late = clock.now() - self._due
        self.worst = max(self.worst, late)
        if late > STALL:
            self.total += late
