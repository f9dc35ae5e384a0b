"""The machine's sockets and pipes in virtual time."""

import asyncio
import functools
import random
import selectors
import threading
from collections.abc import Callable, Coroutine
from typing import Any, ParamSpec, TypeVar

import virtual_loop

P = ParamSpec("P")
T = TypeVar("T")


_REAL_WAIT = 0.001  # s; for a thread that works
_AWAITED = ("reload", "dump")  # names of threads for which time stands still


class _Selector(selectors.DefaultSelector):
    """Waiting for a timer costs no time, waiting for the machine does: the clock jumps.

    It stands still while a daemon's threads work with files.
    """

    now = virtual_loop.START

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        ready = super().select(0)
        if ready or timeout is None:
            return ready or super().select(timeout)
        if timeout > 0 and any(each.name in _AWAITED for each in threading.enumerate()):
            return super().select(_REAL_WAIT)
        self.now += timeout
        return ready


class VirtualSocketsLoop(asyncio.SelectorEventLoop):
    """asyncio's own loop on a virtual clock.

    rng, seen: as of a `VirtualLoop`, of lines in memory.
    """

    def __init__(self) -> None:
        self._virtual = _Selector()
        super().__init__(self._virtual)
        self.rng = random.Random(0)
        self.seen: virtual_loop.Seen = lambda link, toward, data: None

    def time(self) -> float:
        """Virtual seconds."""
        return self._virtual.now

    def run_in_executor(  # type: ignore[override]
        self, executor: Any, func: Callable[..., T], *args: Any
    ) -> "asyncio.Future[T]":
        """Call a function at once."""
        future: asyncio.Future[T] = self.create_future()
        try:
            future.set_result(func(*args))
        except Exception as error:
            future.set_exception(error)
        return future


def run_virtual_on_sockets(main: Coroutine[Any, Any, T]) -> T:
    """As `run_virtual`, for what must have real sockets and pipes."""
    with asyncio.Runner(loop_factory=VirtualSocketsLoop) as runner:
        return runner.run(main)


def in_virtual_time_on_sockets(test: Callable[P, Coroutine[Any, Any, T]]) -> Callable[P, T]:
    """As `in_virtual_time`, for what must have real sockets and pipes."""

    @functools.wraps(test)
    def run(*args: P.args, **kwargs: P.kwargs) -> T:
        return run_virtual_on_sockets(test(*args, **kwargs))

    return run
