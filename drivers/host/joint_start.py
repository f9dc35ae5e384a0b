"""Commits of several lines that arrive at one moment, whatever their speeds and what keeps them.

The remaining skew is that with which the operating system sends bytes.
"""

import asyncio
from collections.abc import Callable
from operator import attrgetter
from typing import NamedTuple, final

from drivers.errors import CommandRefused, Preempted
from drivers.protocol.records import Values

_SLACK = 0.002  # s; timers are up to this late, so the rest of a wait is polled


class _Ready(NamedTuple):
    takes: float
    result: "asyncio.Future[Values]"
    send: Callable[[], None]


@final
class JointStart:
    """Where so many lines wait, each free for its commit; the slowest one sends first.

    until: latest time [s] at which the last line must be free. Where one cannot send, none does.
    """

    def __init__(self, count: int, until: float) -> None:
        self._count = count
        self._ready: list[_Ready] = []
        self._failure: Exception | None = None
        self._arrival = 0.0
        self._looked_at = 0.0
        self._loop = asyncio.get_running_loop()
        self._timer = self._loop.call_at(until, self._give_up)

    def arrive(
        self, takes: float, result: "asyncio.Future[Values]", send: Callable[[], None]
    ) -> None:
        """Note that a line is free for a commit, which takes a time [s] to arrive.

        result: of the commit. send: called once, when it is to be sent, or its result has an error.
        """
        self._ready.append(_Ready(takes, result, send))
        if self._failure is not None:
            self.fail(self._failure)
        elif len(self._ready) == self._count:
            self._timer.cancel()
            self._ready.sort(key=attrgetter("takes"))
            self._arrival = self._loop.time() + self._ready[-1].takes
            self._send_due()

    def fail(self, error: Exception) -> None:
        """Note that one will not be sent: those that were not sent yet are not sent either."""
        self._timer.cancel()
        self._failure = error
        ready, self._ready = self._ready, []
        for each in ready:
            if not each.result.done():
                each.result.set_exception(Preempted(f"one of several commits failed: {error}"))
                each.result.exception()  # retrieved, where nobody waits for it
            each.send()  # nothing, but its line is held no longer

    def _give_up(self) -> None:
        self.fail(CommandRefused("commits must be sent together; one of the lines is too busy"))

    def _send_due(self) -> None:
        now = self._loop.time()
        while self._ready and self._arrival - self._ready[-1].takes <= now:
            self._ready.pop().send()
        if not self._ready:
            return
        due = self._arrival - self._ready[-1].takes
        if now == self._looked_at or due - now > 2 * _SLACK:  # virtual time: its timers are exact
            self._loop.call_at(due if now == self._looked_at else due - _SLACK, self._send_due)
        else:
            self._loop.call_soon(self._send_due)
        self._looked_at = now
