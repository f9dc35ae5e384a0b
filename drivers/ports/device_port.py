"""An open device as a port: read by the event loop, or by a thread where it cannot be watched."""

import asyncio
import contextlib
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import ClassVar

from drivers.errors import LinkError
from registry.threads import close_in_thread

FAILURES: tuple[type[Exception], ...] = (OSError, ValueError, TypeError)
"""Of a device that is gone; TypeError: of pyserial, closed during a read."""


class DevicePort(ABC):
    """A device of this name, which may hang; implements `Port`.

    descriptor: watched by the event loop; None where a thread must read, which may block.
    on_data: called with what is received; on_loss: called once with the cause of a loss; shut:
    closes the device, also a lost one.
    """

    kind: ClassVar[str]
    """What it is, in messages."""
    failures = FAILURES

    def __init__(
        self,
        name: str,
        descriptor: int | None,
        on_data: Callable[[bytes], None],
        on_loss: Callable[[str], None],
        shut: Callable[[], None],
    ) -> None:
        self.name = name
        self.loop = asyncio.get_running_loop()
        self.closing = threading.Event()
        self.descriptor = descriptor
        self._on_data, self._on_loss, self._shut = on_data, on_loss, shut
        self._thread: threading.Thread | None = None
        if descriptor is not None:
            self.loop.add_reader(descriptor, self.poll)
            return
        self._thread = threading.Thread(target=self._run, name=f"era-read {name}", daemon=True)
        self._thread.start()

    @abstractmethod
    def read_watched(self) -> bytes:
        """Return what has come; raises one of `failures`."""

    def read_waiting(self) -> bytes:
        """Return what comes within a short time; raises one of `failures`. Reader thread.

        Of a device without a descriptor.
        """
        raise NotImplementedError

    def poll(self) -> None:
        """Hand over what has come and was not read yet; a reader thread has done so."""
        if self.descriptor is None:
            return
        try:
            data = self.read_watched()
        except self.failures as error:
            self.lose(error)
            return
        self.received(data)  # whatever fails in that is no loss of the port

    def received(self, data: bytes) -> None:
        """Hand over what has come."""
        if data and not self.closing.is_set():
            self._on_data(data)

    def lose(self, problem: Exception) -> LinkError:
        """Close the port and report its loss, once; returns the error of a request."""
        loss = (
            f"{self.kind} {self.name} was lost ({problem}): check the cable and the adapter, then "
            "open the amplifier again"
        )
        if not self.closing.is_set():
            self.close()
            self._on_loss(loss)
        return LinkError(loss)

    def close(self) -> None:
        """Stop reading and writing; `wait_closed` closes the device."""
        self.closing.set()
        watched, self.descriptor = self.descriptor, None
        if watched is not None:
            self.loop.remove_reader(watched)

    async def wait_closed(self) -> None:
        """Wait until it is closed, but not for a device that hangs."""
        # The system waits half a minute for a device that takes no more bytes.
        await close_in_thread(self._close_device, name=f"era-close {self.name}")

    def _close_device(self) -> None:
        if self._thread is not None:
            self._thread.join()
        with contextlib.suppress(*self.failures):
            self._shut()

    def _run(self) -> None:
        """Read until the port is closed or lost; reader thread."""
        post = self.loop.call_soon_threadsafe
        with contextlib.suppress(RuntimeError):  # of a closed loop
            try:
                while not self.closing.is_set():
                    if data := self.read_waiting():
                        post(self.received, data)
            except Exception as error:  # whatever it is, nothing more is read
                post(self.lose, error)
