"""When clients of the API are served: in short turns, with what the control loop leaves.

A share of the event loop's processor time, saved up for bursts, is for clients that touch or hold
the lease, another one for all other clients. A turn is short, and waits while a touch is on its way
to the wire. A client whose input may hold a stop is served at once, within neither limit.
"""

import asyncio
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
        lane = partial(_Lane, self._take, is_busy=is_busy, clock=clock)
        self._first, self._others = lane(), lane()
        self._urgent = lane(is_urgent=True, budget=self._others.budget)
        self._lanes = (self._urgent, self._first, self._others)

    def add(self, connection: Connection) -> None:
        """Serve a client that has lines."""
        waits_in = next((each for each in self._lanes if connection in each.waiting), None)
        if connection.is_urgent:
            lane = self._urgent
        elif waits_in is not None:
            return
        else:
            lane = self._first if self._is_first(connection) else self._others
        if lane is not waits_in:
            if waits_in is not None:
                waits_in.waiting.remove(connection)
            lane.waiting.append(connection)
            lane.schedule()

    def _take(self, waiting: deque[Connection], budget: RateLimiter) -> None:
        """Serve a line of each connection, round and round, until the turn's time is up."""
        began_at, end = self._processor_time(), time.perf_counter() + MAX_TURN
        reading_time = 0.0
        while waiting:
            connection = waiting.popleft()
            self._serve(connection)
            reading_time += connection.reading_time
            connection.reading_time = 0.0
            if connection.has_lines:
                self.add(connection)
            connection.close_if_finished()
            if time.perf_counter() >= end:
                break
        budget.spend(self._processor_time() - began_at + reading_time)


class _Lane:
    """Clients that wait, and when their next turn is.

    take: takes a turn; is_busy: whether turns wait; is_urgent: they wait for nothing, but count in
    the budget, of processor time.
    """

    def __init__(
        self,
        take: Callable[[deque[Connection], RateLimiter], None],
        *,
        is_busy: Callable[[], bool],
        clock: Callable[[], float],
        is_urgent: bool = False,
        budget: RateLimiter | None = None,
    ) -> None:
        self.waiting: deque[Connection] = deque()
        self.budget = budget or RateLimiter(SHARE, burst=BURST, clock=clock)
        self._take = take
        self._is_busy = is_busy
        self._clock = clock
        self._is_urgent = is_urgent
        self._is_turn_scheduled = False
        self._deferred_since: float | None = None

    def schedule(self, delay: float = 0.0) -> None:
        """Schedule a turn unless one is: after a delay [s], or in the next iteration but one.

        Data that arrived meanwhile and what it wakes, such as the control loop for a touch, run
        first, but not before what is urgent.
        """
        if not self.waiting or self._is_turn_scheduled:
            return
        self._is_turn_scheduled = True
        loop = asyncio.get_running_loop()
        if delay > 0:
            loop.call_later(delay, self._take_turn)
        elif self._is_urgent:
            loop.call_soon(self._take_turn)
        else:
            loop.call_soon(loop.call_soon, self._take_turn)

    def _take_turn(self) -> None:
        self._is_turn_scheduled = False
        delay = 0.0 if self._is_urgent else self._delay()
        try:
            if delay <= 0:
                self._deferred_since = None
                self._take(self.waiting, self.budget)
        finally:  # whatever fails: others wait, perhaps with a stop
            self.schedule(delay)

    def _delay(self) -> float:
        """Return the time [s] by which the turn that is due has to wait, 0 for none."""
        if self._is_busy():
            now = self._clock()
            if self._deferred_since is None:
                self._deferred_since = now
            if now - self._deferred_since < MAX_DEFERRAL:
                return _RECHECK
        return self.budget.pause()
