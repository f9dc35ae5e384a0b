"""Hardware and system resources of backends, replaceable for tests in virtual time.

Serial ports, CAN adapters, worker threads and random numbers. Frames, retries and timeouts
are the same with every provider. TCP connections belong to the event loop.
"""

import asyncio
import queue
import secrets
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextvars import ContextVar
from typing import Protocol, TypeVar

from drivers.codec.can_bus.canopen import CanFrame
from drivers.urls.can_bus import CanBusUrl

_T = TypeVar("_T")


class Port(Protocol):
    """An open serial port; data and loss are reported to the callbacks of its opening."""

    @property
    def is_blocked(self) -> bool:
        """Whether it has not taken all bytes yet."""

    def write(self, data: bytes) -> None:
        """Send bytes without waiting, as soon as the line takes them; LinkError if it is lost.

        They replace the unsent rest of earlier ones.
        """

    def poll(self) -> None:
        """Hand over what has come and was not read yet."""

    def close(self) -> None:
        """Close it; no callback is called afterwards."""

    async def wait_closed(self) -> None:
        """Wait until it is closed."""


class Adapter(Protocol):
    """An open CAN adapter; frames and loss are reported to the callbacks of its opening."""

    def send(self, frames: Sequence[CanFrame]) -> int:
        """Send frames back to back without waiting; LinkError if the bus is lost.

        Returns how many of them the adapter took: fewer while its transmit queue is full.
        """

    def close(self) -> None:
        """Close it; no callback is called afterwards."""

    async def wait_closed(self) -> None:
        """Wait until it is closed."""


class Worker:
    """Runs blocking jobs one after the other in a thread; name: of the thread.

    Jobs wait only by its queues and its `sleep`.
    """

    def __init__(self, name: str) -> None:
        self._thread = ThreadPoolExecutor(1, thread_name_prefix=name)

    def submit(self, job: Callable[[], _T]) -> "asyncio.Future[_T]":
        """Run a job after those before it; the future has its result or exception."""
        return asyncio.get_running_loop().run_in_executor(self._thread, job)

    async def close(self) -> None:
        """Finish the running job and take no more."""
        await asyncio.to_thread(self._thread.shutdown)

    def make_queue(self) -> "queue.Queue[bytes]":
        """Make a queue whose `get` blocks."""
        return queue.Queue()

    def sleep(self, seconds: float) -> None:
        """Block for a time [s]."""
        time.sleep(seconds)


class HardwareProvider(ABC):
    """Replacement of the machine's hardware and system resources."""

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
        """Make a worker for blocking jobs."""

    @abstractmethod
    def below(self, limit: int) -> int:
        """Return a random number, 0 to limit - 1."""


HARDWARE_PROVIDER: ContextVar[HardwareProvider | None] = ContextVar(
    "HARDWARE_PROVIDER", default=None
)
"""Provider in this context; None: the machine itself."""


def make_worker(name: str) -> Worker:
    """Make a worker for blocking jobs; name: of its thread."""
    hardware = HARDWARE_PROVIDER.get()
    return Worker(name) if hardware is None else hardware.make_worker()


def number_below(limit: int) -> int:
    """Return an unpredictable number, 0 to limit - 1, or one that the provider chooses."""
    hardware = HARDWARE_PROVIDER.get()
    return secrets.randbelow(limit) if hardware is None else hardware.below(limit)
