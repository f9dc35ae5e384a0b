"""When clients of the API are served: in short turns, with what the control loop leaves.

A share of the event loop's processor time, saved up for bursts, is for clients that touch or hold
the lease, another one for all other clients. A turn is short, and waits while a touch is on its way
to the wire. A client whose input may hold a stop is served at once, within neither limit.
"""

import asyncio
import time
from collections import deque
from collections.abc import Callable

from controller.api.connection import Connection
from controller.process.rate_limit import RateLimiter

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
        self.serve = serve
        self.is_busy = is_busy
        self.clock = clock
        self.processor_time = processor_time
        self._is_first = is_first
        first, others = (RateLimiter(SHARE, burst=BURST, clock=clock) for _ in range(2))
        self._first, self._others = _Lane(self, first), _Lane(self, others)
        self._urgent = _Lane(self, others, is_urgent=True)
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


class _Lane:
    """Clients that wait, and when their next turn is.

    budget: of processor time; is_urgent: they wait for nothing, but count in it.
    """

    def __init__(self, turns: Turns, budget: RateLimiter, *, is_urgent: bool = False) -> None:
        self.waiting: deque[Connection] = deque()
        self._turns = turns
        self._budget = budget
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
        """Serve a line of each client, round and round, until the turn's time is up."""
        self._is_turn_scheduled = False
        if not self._is_urgent and (delay := self._delay()) > 0:
            self.schedule(delay)
            return
        turns = self._turns
        began_at, end = turns.processor_time(), time.perf_counter() + MAX_TURN
        reading_time = 0.0
        self._deferred_since = None
        try:
            while self.waiting:
                connection = self.waiting.popleft()
                turns.serve(connection)
                reading_time += connection.reading_time
                connection.reading_time = 0.0
                if connection.has_lines:
                    turns.add(connection)
                connection.close_if_finished()
                if time.perf_counter() >= end:
                    break
        finally:  # whatever fails: others wait, perhaps with a stop
            self._budget.spend(turns.processor_time() - began_at + reading_time)
            self.schedule()

    def _delay(self) -> float:
        """Return the time [s] by which the turn that is due has to wait, 0 for none."""
        if self._turns.is_busy():
            now = self._turns.clock()
            if self._deferred_since is None:
                self._deferred_since = now
            if now - self._deferred_since < MAX_DEFERRAL:
                return _RECHECK
        return self._budget.pause()
