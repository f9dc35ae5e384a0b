"""When clients of the API are served: in short turns, with what the control loop leaves.

A share of the event loop's processor time, saved up for bursts, is for clients that touch or hold
the lease, another one for all other clients. A turn is short, and waits while a touch is on its way
to the wire. A client whose input may hold a stop is served at once, within neither limit.
"""

import asyncio
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

from controller.api.connection import Connection
from controller.process.rate_limit import RateLimiter

MAX_TURN = 0.0001  # s, and one request; how long a touch waits for clients of either share
SHARE = 0.25  # of the event loop's time, for those that touch, and for the others together
BURST = 0.02  # s of processor time, saved up
MAX_DEFERRAL = 0.003  # s; of a turn by touches, which may follow each other without a gap
_RECHECK = 0.0005  # s; of a turn that is deferred


@dataclass(eq=False, slots=True)
class _Lane:
    """Clients that wait, and what is known of their next turn.

    budget: of processor time; is_urgent: they wait for nothing, but count in it.
    """

    budget: RateLimiter
    is_urgent: bool = False
    waiting: deque[Connection] = field(default_factory=deque)
    is_scheduled: bool = False
    deferred_since: float | None = None


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
        self._is_busy = is_busy
        self._clock = clock
        self._processor_time = processor_time
        self._is_first = is_first
        first, others = (RateLimiter(SHARE, burst=BURST, clock=clock) for _ in range(2))
        self._first, self._others = _Lane(first), _Lane(others)
        self._urgent = _Lane(others, is_urgent=True)

    def add(self, connection: Connection) -> None:
        """Serve a client that has lines."""
        lanes = (self._urgent, self._first, self._others)
        waits_in = next((each for each in lanes if connection in each.waiting), None)
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
            if lane.is_urgent:  # before what has arrived meanwhile
                asyncio.get_running_loop().call_soon(self._take_turn, lane)
            else:
                self._schedule(lane)

    def _schedule(self, lane: _Lane, delay: float = 0.0) -> None:
        """Schedule a turn unless one is: after a delay [s], or in the next iteration but one.

        Data that arrived meanwhile and what it wakes, such as the control loop for a touch, run
        first.
        """
        if not lane.waiting or lane.is_scheduled:
            return
        lane.is_scheduled = True
        loop = asyncio.get_running_loop()
        if delay > 0:
            loop.call_later(delay, self._take_turn, lane)
        else:
            loop.call_soon(loop.call_soon, self._take_turn, lane)

    def _take_turn(self, lane: _Lane) -> None:
        """Serve a line of each client, round and round, until the turn's time is up."""
        lane.is_scheduled = False
        if not lane.is_urgent and (delay := self._delay(lane)) > 0:
            self._schedule(lane, delay)
            return
        began_at, end = self._processor_time(), time.perf_counter() + MAX_TURN
        reading_time = 0.0
        lane.deferred_since = None
        try:
            while lane.waiting:
                connection = lane.waiting.popleft()
                self._serve(connection)
                reading_time += connection.reading_time
                connection.reading_time = 0.0
                if connection.has_lines:
                    self.add(connection)
                connection.close_if_finished()
                if time.perf_counter() >= end:
                    break
        finally:  # whatever fails: others wait, perhaps with a stop
            lane.budget.spend(self._processor_time() - began_at + reading_time)
            self._schedule(lane)

    def _delay(self, lane: _Lane) -> float:
        """Return the time [s] by which the turn that is due has to wait, 0 for none."""
        if self._is_busy():
            now = self._clock()
            if lane.deferred_since is None:
                lane.deferred_since = now
            if now - lane.deferred_since < MAX_DEFERRAL:
                return _RECHECK
        return lane.budget.pause()
