"""Event loop with virtual time: if no task is ready, the clock jumps to the next timer.

Computing takes no virtual time. A program that runs in a single loop therefore gives the same
results on every machine, and never waits for a timer. Sockets work as usual. Results are
reproducible only if data arrives immediately, as through Unix sockets within a process.
"""

import asyncio
import math
import selectors
import threading
from collections.abc import Callable, Coroutine
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, TypeVar

from registry import threads

T = TypeVar("T")

START = 1000.0
"""Virtual time at the start [s]; not zero, because code could use zero for "never"."""
_MAX_TURNS = 20_000  # of the loop without progress of time; more are an endless loop
_THREAD_WAIT = 0.001  # s of real time between checks whether threads still work


class Stuck(Exception):
    """Deadlock: no timer and no ready task, or no progress of time."""


class VirtualTimeLoop(asyncio.SelectorEventLoop):
    """Event loop with virtual time; executor functions run immediately, in the loop itself."""

    def __init__(self) -> None:
        self.now = START
        super().__init__(_JumpingSelector(self))

    def time(self) -> float:
        """Return the virtual time [s]."""
        return self.now

    @property
    def waits_for_threads(self) -> bool:
        """Whether the clock is stopped because threads are working for this program."""
        return threads.are_at_work()

    @property
    def _clock_resolution(self) -> float:
        """Resolution of the clock: the smallest possible step, so that no timer fires early."""
        return math.ulp(self.now)

    @_clock_resolution.setter
    def _clock_resolution(self, resolution: float) -> None:
        """Ignore the resolution of the machine's clock, which asyncio sets."""

    def run_in_executor(  # type: ignore[override]
        self, executor: Any, func: Callable[..., T], *args: Any
    ) -> "asyncio.Future[T]":
        """Run the function immediately in the loop's thread."""
        future: asyncio.Future[T] = self.create_future()
        try:
            future.set_result(func(*args))
        except Exception as error:
            future.set_exception(error)
        return future


class _JumpingSelector(selectors.DefaultSelector):
    """Selector that advances the virtual clock to the next timer, but waits for working threads."""

    def __init__(self, loop: VirtualTimeLoop) -> None:
        super().__init__()
        self._loop = loop
        self._turns = 0

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        """Return the ready events; if no event is ready, advance the clock to the next timer.

        Raises Stuck for a deadlock.
        """
        self._turns += 1
        if self._turns > _MAX_TURNS:
            self._turns = 0
            raise Stuck(f"{_MAX_TURNS} turns at one moment: a task reschedules itself endlessly")
        # Only the loop's own pipe is registered, and no other thread could write to it.
        is_alone = len(self.get_map()) == 1 == threading.active_count()
        # Read before the pipe: a thread first writes its result to the pipe, then stops working.
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


class VirtualLoopRunner:
    """Virtual-time loop in a separate thread; time passes only while the loop runs work.

    Its tasks pause between two calls, however long the caller takes.
    """

    def __init__(self) -> None:
        self.is_open = True
        """Whether it runs coroutines."""
        self._loop = VirtualTimeLoop()
        # A notebook has a running loop in its own thread.
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="virtual time")

    def run(self, work: Coroutine[Any, Any, T]) -> T:
        """Run a coroutine and wait for its result; cancel it on Ctrl-C."""
        result = asyncio.run_coroutine_threadsafe(work, self._loop)
        running = self._thread.submit(self._run_until_done, result)
        try:
            return running.result()
        except BaseException:
            result.cancel()
            raise

    def _run_until_done(self, result: "Future[T]") -> T:
        return self._loop.run_until_complete(asyncio.wrap_future(result, loop=self._loop))

    def close(self) -> None:
        """End the thread."""
        if self.is_open:
            self.is_open = False
            self._thread.submit(self._loop.close).result()
            self._thread.shutdown()
