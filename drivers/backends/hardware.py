"""What backends take from the machine they run on, and who may stand in for it.

Serial ports, CAN adapters, threads for what blocks, and chance: that is the machine's, and what a
bench in virtual time has to bring itself. Frames, turns, retries and time-outs are not in here, and
run the same on both. TCP connections are the event loop's own.
"""

import asyncio
import queue
import secrets
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextvars import ContextVar
from typing import Protocol, TypeVar, final

from drivers.backends.urls.can_bus import CanBusUrl
from drivers.codec.can_bus.frame import CanFrame

_T = TypeVar("_T")


class Port(Protocol):
    """An open serial port. What it reads, and once why it was lost, goes to who opened it."""

    def write(self, data: bytes) -> None:
        """Send bytes; LinkTimeout where the line takes no more, LinkError where it is gone."""

    def close(self) -> None:
        """Close it; nothing is told any more."""

    async def wait_closed(self) -> None:
        """See the closing through."""


class Adapter(Protocol):
    """An open CAN adapter. What it hears, and once why it was lost, goes to who opened it."""

    def send(self, frames: Sequence[CanFrame]) -> None:
        """Send frames without another's in between; LinkError where the bus is gone."""

    def close(self) -> None:
        """Close it; nothing is told any more."""

    async def wait_closed(self) -> None:
        """See the closing through."""


class Worker(ABC):
    """Does jobs that block, one after the other, beside the event loop.

    In a job, waiting is its own: its queues and its `sleep`.
    """

    @abstractmethod
    def submit(self, job: Callable[[], _T]) -> "asyncio.Future[_T]":
        """Do a job when those before it are done; what it returns or raises."""

    @abstractmethod
    async def close(self) -> None:
        """Wait for what is under way; nothing is taken any more."""

    @abstractmethod
    def make_queue(self) -> "queue.Queue[bytes]":
        """A queue whose `get` blocks."""

    @abstractmethod
    def sleep(self, seconds: float) -> None:
        """Block for so long [s]."""


@final
class ThreadWorker(Worker):
    """Does them in a thread."""

    def __init__(self, name: str) -> None:
        self._thread = ThreadPoolExecutor(1, thread_name_prefix=name)

    def submit(self, job: Callable[[], _T]) -> "asyncio.Future[_T]":
        """See `Worker`."""
        return asyncio.get_running_loop().run_in_executor(self._thread, job)

    async def close(self) -> None:
        """See `Worker`."""
        await asyncio.to_thread(self._thread.shutdown)

    def make_queue(self) -> "queue.Queue[bytes]":
        """See `Worker`."""
        return queue.Queue()

    def sleep(self, seconds: float) -> None:
        """See `Worker`."""
        time.sleep(seconds)


class HardwareProvider(ABC):
    """What stands in for the machine."""

    @abstractmethod
    async def open_port(
        self, name: str, *, on_data: Callable[[bytes], None], on_loss: Callable[[str], None]
    ) -> Port:
        """Open a serial port; raises LinkError."""

    @abstractmethod
    async def open_adapter(
        self,
        url: CanBusUrl,
        *,
        on_frame: Callable[[CanFrame], None],
        on_loss: Callable[[str], None],
    ) -> Adapter:
        """Open a CAN adapter; raises LinkError."""

    @abstractmethod
    def make_worker(self) -> Worker:
        """Somebody for jobs that block."""

    @abstractmethod
    def below(self, limit: int) -> int:
        """A number from 0 to limit - 1, by chance."""


HARDWARE_PROVIDER: ContextVar[HardwareProvider | None] = ContextVar(
    "HARDWARE_PROVIDER", default=None
)
"""Who stands in for the machine in this context; nobody as a rule."""


def make_worker(name: str) -> Worker:
    """Somebody for jobs that block; name: of the thread."""
    hardware = HARDWARE_PROVIDER.get()
    return ThreadWorker(name) if hardware is None else hardware.make_worker()


def number_below(limit: int) -> int:
    """A number from 0 to limit - 1 that nobody can guess, or that the stand-in has chosen."""
    hardware = HARDWARE_PROVIDER.get()
    return secrets.randbelow(limit) if hardware is None else hardware.below(limit)
