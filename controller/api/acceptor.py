"""Acceptance of connections to the daemon's socket: one per turn, refused above a rate per process.

A refusal costs some microseconds, so that processes that connect again and again delay neither the
control loop nor the clients that wait behind them in the queue.
"""

import asyncio
import contextlib
import os
import socket
from collections.abc import Callable
from functools import partial

from controller.api.connection import Connection
from controller.api.peer import credentials_of
from controller.api.rate_limit import RateLimiter

MAX_CONNECTION_RATE = 20.0  # 1/s; connections of one process
CONNECTION_BURST = 64  # connections
_MAX_RATES = 256  # processes, above which those that have not connected lately are dropped
_QUEUE = 512  # connections
_REFUSALS_PER_TURN = 8
_PAUSE = 0.1  # s; while there is no descriptor at all


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
        self._clock = clock
        self._loop = asyncio.get_running_loop()
        self._beginning: set[asyncio.Task[object]] = set()
        self._rates: dict[int, RateLimiter] = {}  # by process
        self._spare = _spare_descriptor()
        bound.setblocking(False)
        bound.listen(_QUEUE)
        self._start_serving()

    def close(self) -> None:
        """Stop listening."""
        self._loop.remove_reader(self._bound)
        self._bound.close()
        if self._spare is not None:
            os.close(self._spare)

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
            if self._is_within_rate(process):
                make = partial(self._make_connection, process)
                task = self._loop.create_task(self._loop.connect_accepted_socket(make, accepted))
                self._beginning.add(task)
                task.add_done_callback(self._beginning.discard)
                return
            accepted.close()

    def _is_within_rate(self, process: int) -> bool:
        if len(self._rates) >= _MAX_RATES:
            self._rates = {id: each for id, each in self._rates.items() if not each.is_unused}
        rate = self._rates.get(process)
        if rate is None:
            rate = RateLimiter(MAX_CONNECTION_RATE, burst=CONNECTION_BURST, clock=self._clock)
            self._rates[process] = rate
        return rate.take()

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
