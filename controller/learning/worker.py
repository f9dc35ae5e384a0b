"""A process beside the daemon, whose calls have a time limit.

The estimator of the plate works in it, at a lower priority, so that the control loop does not wait
for it. One that hangs can be killed at any moment, and the kernel ends it with the daemon.
"""

import asyncio
import contextlib
import os
import resource
import signal
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import active_children, get_context
from typing import Any, TypeVar

from controller.process.child import end_with_parent

MAX_MEMORY = 384 << 20
"""Bytes that a worker may take; one that needs more ends, and another starts.

With a daemon of sixteen ERAs, 0.4 GB, and its dashboard, 0.1 GB, that stays below the `MemoryMax`
of the service's unit, at which the system would end the daemon as well.
"""

_NICE = 10  # above that of the daemon, whose loop comes first
_OF_DAEMON = {signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGUSR1}
"""Signals that the daemon handles; a group or a service gets them as a whole."""

_Result = TypeVar("_Result")


class Worker:
    """A process that calls functions one at a time.

    Nothing of it waits in this process but the caller of `call`. To be made in the main thread,
    whose end is that of the process to the kernel.
    """

    def __init__(self) -> None:
        before = {*active_children()}
        self._pool = ProcessPoolExecutor(1, get_context("spawn"), _start_process, (os.getpid(),))
        mask = signal.pthread_sigmask(signal.SIG_BLOCK, _OF_DAEMON)  # the process inherits it
        try:
            self._pool.submit(os.getpid)
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        (self._process,) = {*active_children()} - before
        self.pid = self._process.pid
        """Process number."""

    async def call(
        self, limit: float, function: Callable[..., _Result], *arguments: object
    ) -> _Result:
        """Return what a function returns in the process within a time limit [s].

        Raises what the function does, TimeoutError, and ChildProcessError where the process has
        died.
        """
        try:
            async with asyncio.timeout(limit):
                return await asyncio.wrap_future(self._pool.submit(function, *arguments))
        except BrokenProcessPool:
            raise ChildProcessError("its process has died") from None
        except TimeoutError:
            raise TimeoutError(f"no reply within {limit:g} s") from None

    def end(self) -> None:
        """Kill the process, whatever it does."""
        self._process.kill()
        self._pool.shutdown(wait=False, cancel_futures=True)


def _start_process(parent: int) -> None:
    """Start the process of a worker."""
    end_with_parent(parent, signal.SIGKILL)
    with contextlib.suppress(OSError):
        os.nice(_NICE)
    with contextlib.suppress(ValueError):  # less is allowed already
        resource.setrlimit(resource.RLIMIT_DATA, (MAX_MEMORY, MAX_MEMORY))


_made: Any  # in the process of a worker


def make(factory: Callable[..., object], *arguments: object) -> None:
    """Make the object of a worker, within its process."""
    global _made
    _made = factory(*arguments)


def of_made(method: Callable[..., _Result], *arguments: object) -> _Result:
    """Return what a method of the object that was made returns."""
    return method(_made, *arguments)
