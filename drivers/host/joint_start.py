"""Commits of several lines that arrive at one moment, whatever keeps the lines and their speeds.

The remaining skew is that with which the operating system sends bytes. Times [s] are of the event
loop's clock.
"""

import asyncio
from collections.abc import Callable
from operator import itemgetter
from typing import TypeAlias, final

from drivers.errors import CommandRefused, Preempted

_SLACK = 0.002  # s; timers are up to this late, so the rest of a wait is polled

Release: TypeAlias = Callable[[Exception | None], None]
"""Sends a commit that was held, or fails it with an error."""


@final
class JointStart:
    """Where so many lines wait, each free for its commit; the slowest one sends first.

    until: latest time [s] at which the commits must arrive. Where one cannot send, none does that
    has not sent before.
    """

    def __init__(self, count: int, until: float) -> None:
        self._count, self._until = count, until
        self._ready: list[tuple[float, Release]] = []  # how long each takes to arrive
        self._failure: Exception | None = None
        self._arrival = 0.0
        self._looked_at = 0.0
        self._loop = asyncio.get_running_loop()
        self._timer = self._loop.call_at(until, self._give_up)

    def arrive(self, takes: float, release: Release) -> None:
        """Note that a line is free for a commit, which takes a time [s] to arrive.

        release: called once; calls `fail` where that does not succeed.
        """
        self._ready.append((takes, release))
        if self._failure is not None:
            self._keep_back(self._failure)
        elif len(self._ready) == self._count:
            self._ready.sort(key=itemgetter(0))
            self._arrival = self._loop.time() + self._ready[-1][0]
            if self._arrival > self._until:
                self._give_up()
                return
            self._timer.cancel()
            self._loop.call_soon(self._send_due)  # none behind the pump of the line that came last

    def fail(self, error: Exception) -> None:
        """Note that one will not be sent: those that were not sent yet are not sent either."""
        self._keep_back(Preempted(f"one of several commits failed: {error}"))

    def _give_up(self) -> None:
        text = "commits must be sent together; one of the lines is too busy"
        self._keep_back(CommandRefused(text, until=self._loop.time()))

    def _keep_back(self, error: Exception) -> None:
        """Send none that waits or comes later: each fails with the first error of them."""
        self._timer.cancel()
        self._failure = self._failure or error
        ready, self._ready = self._ready, []
        for _, release in ready:
            release(self._failure)

    def _send_due(self) -> None:
        now = self._loop.time()
        while self._ready and self._arrival - self._ready[-1][0] <= now:
            self._ready.pop()[1](None)
        if not self._ready:
            return
        due = self._arrival - self._ready[-1][0]
        if now == self._looked_at or due - now > 2 * _SLACK:  # virtual time: its timers are exact
            self._loop.call_at(due if now == self._looked_at else due - _SLACK, self._send_due)
        else:
            self._loop.call_soon(self._send_due)
        self._looked_at = now
