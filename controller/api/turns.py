"""When clients of the API are served: in short turns, with what the control loop leaves.

A share of the event loop's processor time, saved up for bursts, is for clients that touch or hold
the lease, another one for all other clients. A turn is short, and waits while a touch is on its way
to the wire. A client whose input may hold a stop is served at once, within neither limit.
"""

import asyncio
import contextlib
import time
from collections import deque
from collections.abc import Callable
from functools import partial

from controller.api.connection import Connection
from controller.api.rate_limit import RateLimiter

MAX_TURN = 0.0001  # s, and one request; how long a touch waits for clients of either share
SHARE = 0.25  # of the event loop's time, for those that touch, and for the others together
BURST = 0.02  # s of processor time, saved up
MAX_DEFERRAL = 0.003  # s; of a turn by touches, which may follow each other without a gap
_RECHECK = 0.0005  # s; of a turn that is deferred
MAX_EXCESS = 3  # requests beyond a client's rate, after which it pauses
PAUSE = 0.001  # s


class Turns:
    """Serves waiting clients in turn, a line of each.

    serve: serves one line of a client; is_first: whether a client touches or holds the lease;
    is_busy: whether a touch is on its way to the wire; clock [s]; processor_time: of this thread
    [s].
    """

    def __init__(
        self,
        serve: Callable[[Connection], None],
        *,
        is_first: Callable[[Connection], bool],
        is_busy: Callable[[], bool],
        clock: Callable[[], float],
        processor_time: Callable[[], float],
    ) -> None:
        self._serve = serve
        self._is_first = is_first
        self._processor_time = processor_time
        share = partial(RateLimiter, SHARE, burst=BURST, clock=clock)
        lane = partial(_Lane, self._take, is_busy=is_busy, clock=clock)
        self._first, self._others = lane(share()), lane(share())
        self._urgent: deque[Connection] = deque()
        self._is_urgent_due = False

    def add(self, connection: Connection) -> None:
        """Serve a client that has lines."""
        lanes = (self._first.waiting, self._others.waiting)
        if connection.is_urgent:
            for waiting in lanes:
                with contextlib.suppress(ValueError):
                    waiting.remove(connection)
            if connection not in self._urgent:
                self._urgent.append(connection)
            if not self._is_urgent_due:
                self._is_urgent_due = True
                asyncio.get_running_loop().call_soon(self._take_urgent)
        elif not connection.is_paused and not any(
            connection in each for each in (*lanes, self._urgent)
        ):
            (self._first if self._is_first(connection) else self._others).add(connection)

    def _take_urgent(self) -> None:
        """Serve clients whose input may hold a stop, within no limit, but counted."""
        try:
            self._take(self._urgent, self._others.budget)
        finally:  # whatever fails: another stop may wait
            self._is_urgent_due = bool(self._urgent)
            if self._is_urgent_due:
                asyncio.get_running_loop().call_soon(self._take_urgent)

    def _take(self, waiting: deque[Connection], budget: RateLimiter) -> None:
        """Serve a line of each connection, round and round, until the turn's time is up."""
        began_at, end = self._processor_time(), time.perf_counter() + MAX_TURN
        reading_time = 0.0
        while waiting:
            connection = waiting.popleft()
            self._serve(connection)
            reading_time += connection.reading_time
            connection.reading_time = 0.0
            if connection.excess >= MAX_EXCESS and not connection.is_urgent:
                self._pause(connection)
            elif connection.has_lines:
                self.add(connection)
            connection.close_if_finished()
            if time.perf_counter() >= end:
                break
        budget.spend(self._processor_time() - began_at + reading_time)

    def _pause(self, connection: Connection) -> None:
        """Serve a client that exceeds its rate a little at a time, so that it delays no one."""
        connection.is_paused = True
        asyncio.get_running_loop().call_later(PAUSE, self._resume, connection)

    def _resume(self, connection: Connection) -> None:
        connection.is_paused = False
        connection.excess = 0
        if connection.has_lines:
            self.add(connection)


class _Lane:
    """Clients that wait, and when their next turn is.

    take: takes a turn; budget: of processor time; is_busy: whether turns wait.
    """

    def __init__(
        self,
        take: Callable[[deque[Connection], RateLimiter], None],
        budget: RateLimiter,
        *,
        is_busy: Callable[[], bool],
        clock: Callable[[], float],
    ) -> None:
        self.waiting: deque[Connection] = deque()
        self.budget = budget
        self._take = take
        self._is_busy = is_busy
        self._clock = clock
        self._is_turn_scheduled = False
        self._deferred_since: float | None = None

    def add(self, connection: Connection) -> None:
        """Let a client wait for its turn."""
        self.waiting.append(connection)
        self._schedule()

    def _schedule(self, delay: float = 0.0) -> None:
        """Schedule a turn unless one is: after a delay [s], or in the next iteration but one.

        Data that arrived meanwhile and what it wakes, such as the control loop for a touch, run
        first.
        """
        if not self.waiting or self._is_turn_scheduled:
            return
        self._is_turn_scheduled = True
        loop = asyncio.get_running_loop()
        if delay > 0:
            loop.call_later(delay, self._take_turn)
        else:
            loop.call_soon(loop.call_soon, self._take_turn)

    def _take_turn(self) -> None:
        self._is_turn_scheduled = False
        delay = self._delay()
        if delay <= 0:
            self._deferred_since = None
            self._take(self.waiting, self.budget)
        self._schedule(delay)

    def _delay(self) -> float:
        """Return the time [s] by which the turn that is due has to wait, 0 for none."""
        if self._is_busy():
            now = self._clock()
            if self._deferred_since is None:
                self._deferred_since = now
            if now - self._deferred_since < MAX_DEFERRAL:
                return _RECHECK
        return self.budget.pause()
