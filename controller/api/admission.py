"""Which clients are connected: acceptance of connections, and places for clients.

Connections to the daemon's socket are accepted one per turn, and refused above a rate per process.
A refusal costs some microseconds, so that processes that connect again and again delay neither the
control loop nor the clients that wait behind them in the queue.

However many clients there are, another one can connect and `stop`, as there are places in reserve
for methods that silence. A client that has sent nothing yet is evicted first, then an idle
subscriber, then any idle client; never one that holds the arming lease or waits for a response. The
reserve is shared among processes: a client of the one with the most there is evicted, silent ones
first, but none whose first bytes have arrived unread.
"""

import asyncio
import contextlib
import os
import resource
import socket
from collections import Counter
from collections.abc import Callable
from functools import partial

from controller.api.connection import Connection
from controller.api.place import credentials_of
from controller.process.rate_limit import Rates

MAX_CONNECTIONS = 32  # for all methods
RESERVE = 8  # further ones, for the methods in reserve alone
IDLE_TIMEOUT = 1.0  # s; without a request, after which a client may be evicted
SILENT_TIMEOUT = 0.1  # s; the same for one that has sent nothing yet
MAX_CONNECTION_RATE = 20.0  # 1/s; connections of one process
CONNECTION_BURST = 64  # connections
_QUEUE = 512  # connections
_REFUSALS_PER_TURN = 8
_PAUSE = 0.1  # s; while there is no descriptor at all


class Admission:
    """The connected clients; holds_lease: whether a client does."""

    def __init__(
        self, *, holds_lease: Callable[[Connection], bool], clock: Callable[[], float]
    ) -> None:
        self.admitted: set[Connection] = set()
        self._holds_lease = holds_lease
        self._clock = clock

    def admit(self, new: Connection) -> None:
        """Admit a new client, if necessary in place of another, or close it."""
        new.is_reserve = not self._has_room()
        if new.is_reserve:
            reserve = [each for each in self.admitted if each.is_reserve]
            if len(reserve) >= RESERVE:
                evicted = _evictable(reserve, new)
                if evicted is None:
                    new.abort()
                    return
                self._drop(evicted)
        self.admitted.add(new)

    def promote(self, one: Connection) -> bool:
        """Whether a client is now served all methods."""
        if one.is_reserve and self._has_room():
            one.is_reserve = False
        return not one.is_reserve

    def _has_room(self) -> bool:
        full = [each for each in self.admitted if not each.is_reserve]
        if len(full) < MAX_CONNECTIONS:
            return True
        candidates = [each for each in full if not each.pending and not self._holds_lease(each)]
        now, timeout = self._clock(), SILENT_TIMEOUT
        idle = [each for each in candidates if not each.has_spoken]
        if not idle:
            timeout = IDLE_TIMEOUT
            expired = [each for each in candidates if now - each.received_at >= timeout]
            idle = [each for each in expired if each.topics] or expired
        evictable = min(idle, key=lambda each: each.received_at, default=None)
        if evictable is None or now - evictable.received_at < timeout:
            return False
        self._drop(evictable)
        return True

    def _drop(self, one: Connection) -> None:
        self.admitted.discard(one)
        one.abort()


def _evictable(reserve: list[Connection], new: Connection) -> Connection | None:
    """The client in reserve that a new one replaces, or None.

    Of its own process, or of one with more clients there.
    """
    counts = Counter(each.process for each in reserve)
    candidates = [
        each
        for each in reserve
        if not each.pending
        and (each.process == new.process or counts[each.process] > counts[new.process])
        and not each.is_unread
    ]
    return min(
        candidates,
        key=lambda each: (-counts[each.process], each.has_spoken, each.received_at),
        default=None,
    )


class Acceptor:
    """Accepts connections of a bound Unix socket.

    make_connection: called with the id of the connecting process; clock [s].
    """

    def __init__(
        self,
        bound: socket.socket,
        make_connection: Callable[[int], Connection],
        *,
        clock: Callable[[], float],
    ) -> None:
        self._bound = bound
        self._make_connection = make_connection
        self._loop = asyncio.get_running_loop()
        self._beginning: set[asyncio.Task[object]] = set()
        self._rates = Rates(MAX_CONNECTION_RATE, burst=CONNECTION_BURST, clock=clock)
        self._spare = _spare_descriptor()
        bound.setblocking(False)
        bound.listen(_QUEUE)
        self._start_serving()

    async def close(self) -> None:
        """Stop listening; return once what was accepted is open."""
        self._loop.remove_reader(self._bound)
        self._bound.close()
        if self._spare is not None:
            os.close(self._spare)
        await asyncio.gather(*self._beginning, return_exceptions=True)

    def _start_serving(self) -> None:
        if self._bound.fileno() >= 0:
            self._loop.add_reader(self._bound, self._accept)

    def _accept(self) -> None:
        """Accept one connection, after at most some that are refused."""
        for _ in range(_REFUSALS_PER_TURN):
            try:
                accepted, _ = self._bound.accept()
            except (BlockingIOError, InterruptedError, ConnectionAbortedError):
                return
            except OSError:
                self._refuse_without_descriptors()
                return
            process, _ = credentials_of(accepted) or (0, 0)
            if self._rates.of(process).take():
                make = partial(self._make_connection, process)
                task = self._loop.create_task(self._loop.connect_accepted_socket(make, accepted))
                self._beginning.add(task)
                task.add_done_callback(self._beginning.discard)
                return
            accepted.close()

    def _refuse_without_descriptors(self) -> None:
        """Refuse a connection by means of the spare descriptor; pause if it was taken meanwhile."""
        if self._spare is not None:
            os.close(self._spare)
            with contextlib.suppress(OSError):
                self._bound.accept()[0].close()
        self._spare = _spare_descriptor()
        if self._spare is None:
            self._loop.remove_reader(self._bound)
            self._loop.call_later(_PAUSE, self._start_serving)


def _spare_descriptor() -> int | None:
    """A descriptor to be given up for another, or None if there is no more."""
    try:
        return os.open(os.devnull, os.O_RDONLY | os.O_CLOEXEC)
    except OSError:
        return None


MIN_DESCRIPTORS = 64
_MAX_DESCRIPTORS = 65_536


def allow_many_descriptors() -> int:
    """Raise the limit, so that idle connections do not use it up; return it."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    limit = _MAX_DESCRIPTORS if hard == resource.RLIM_INFINITY else hard
    with contextlib.suppress(OSError, ValueError):
        resource.setrlimit(resource.RLIMIT_NOFILE, (limit, hard))
        return limit
    return soft
