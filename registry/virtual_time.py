"""Virtual time: an event loop whose clock jumps to its next timer as soon as nothing is ready.

Computing takes no time on this clock. A program that runs entirely in one loop therefore gives the
same results on every machine, and ends as soon as they are computed. Sockets work as usual and cost
no time, so they are reproducible only if the machine delivers data immediately, as Unix sockets
within a process do.
"""

import asyncio
import math
import selectors
import threading
from collections.abc import Callable
from typing import Any, TypeVar

from registry import threads

T = TypeVar("T")

START = 1000.0
"""Time [s] at which the clock begins; not zero, which code could take for "never"."""
_MAX_TURNS = 20_000  # at one moment; more are an endless loop
_THREAD_WAIT = 0.001  # s of the machine's time; between looks at threads that work


class Stuck(Exception):
    """Deadlock: no timer and no ready task, or no progress of time."""


class VirtualTimeLoop(asyncio.SelectorEventLoop):
    """Event loop with virtual time; executor functions run immediately, in the loop itself."""

    def __init__(self) -> None:
        self.now = START
        super().__init__(_JumpingSelector(self))

    def time(self) -> float:
        """Virtual seconds."""
        return self.now

    @property
    def waits_for_threads(self) -> bool:
        """Whether the clock is stopped because threads are working for this program."""
        return threads.are_at_work()

    @property
    def _clock_resolution(self) -> float:
        """Resolution of the clock: the smallest step, so that no timer fires early."""
        return math.ulp(self.now)

    @_clock_resolution.setter
    def _clock_resolution(self, of_the_machine: float) -> None:
        """Ignore the resolution of the machine's clock."""

    def run_in_executor(  # type: ignore[override]
        self, executor: Any, func: Callable[..., T], *args: Any
    ) -> "asyncio.Future[T]":
        """Run the function immediately: there are no threads."""
        future: asyncio.Future[T] = self.create_future()
        try:
            future.set_result(func(*args))
        except Exception as error:
            future.set_exception(error)
        return future


class _JumpingSelector(selectors.DefaultSelector):
    """Never waits for a timer: it moves the clock there. It waits for threads that work."""

    def __init__(self, loop: VirtualTimeLoop) -> None:
        super().__init__()
        self._loop = loop
        self._turns = 0

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        """Return the ready events; if there are none and a timer is set, advance the clock to
        it."""
        self._turns += 1
        if self._turns > _MAX_TURNS:
            self._turns = 0
            raise Stuck(f"{_MAX_TURNS} turns at one moment: a task reschedules itself endlessly")
        # Nothing but the loop's own pipe, and no thread that could write to it.
        is_alone = len(self.get_map()) == 1 == threading.active_count()
        # Before looking at the pipe: a thread writes to it first, and is no longer at work then.
        is_held = timeout != 0 and not is_alone and self._loop.waits_for_threads
        ready = [] if is_alone else super().select(0)
        if ready or timeout == 0:
            return ready
        self._turns = 0
        if timeout is None:
            if is_alone:
                raise Stuck("deadlock: no timer and no ready task")
            return super().select(timeout)
        if is_held:
            return super().select(_THREAD_WAIT)
        next_timer = self._loop._scheduled[0].when()  # type: ignore[attr-defined]
        self._loop.now = max(self._loop.now, next_timer)
        return ready
