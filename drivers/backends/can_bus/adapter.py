"""An open CAN adapter, read by a thread, which works with every python-can interface."""

import asyncio
import contextlib
import logging
import threading
from collections.abc import Callable, Sequence
from typing import final

import can

from drivers.backends.can_bus.interfaces import flush, open_bus, send_some, wake
from drivers.codec.can_bus.canopen import CanFrame
from drivers.errors import LinkError, system_message
from drivers.hardware import HARDWARE_PROVIDER, Adapter
from drivers.ports.watched import remedy_of
from drivers.threads import close_in_thread, in_thread
from drivers.urls.can_bus import CanBusUrl

_READ_TIMEOUT = 0.05  # s; interval in which the reader notices its end
_BUS_OFF = 0x40  # error class of SocketCAN
FULL_PAUSE = 0.0005  # s; before frames are sent again to a full transmit queue
_BUS_OFF_MESSAGE = "the adapter went bus-off; check wiring, termination and bit rate"
_CAN_ERRORS = (can.CanError, OSError, ValueError, TypeError)  # TypeError: closed during a read

logging.getLogger("can").addHandler(logging.NullHandler())  # its messages become LinkErrors


async def open_adapter(
    url: CanBusUrl, *, on_frame: Callable[[CanFrame], None], on_loss: Callable[[str], None]
) -> Adapter:
    """Open the adapter to a bus; raises LinkError.

    on_frame: called with each frame, in the reader thread; on_loss: called once, in the event loop,
    with the cause of a loss.
    """
    hardware = HARDWARE_PROVIDER.get()
    if hardware is not None:
        return await hardware.open_adapter(url, on_frame=on_frame, on_loss=on_loss)
    try:
        bus = await in_thread(lambda: open_bus(url), name=f"era-open {url}", undo=_shut)
    except Exception as problem:  # of the drivers of many vendors
        raise LinkError(_open_error_message(url, problem)) from problem
    return _ThreadedAdapter(bus, url, on_frame, on_loss)


@final
class _ThreadedAdapter:
    """An adapter opened by `open_adapter`."""

    def __init__(
        self,
        bus: can.BusABC,
        url: CanBusUrl,
        on_frame: Callable[[CanFrame], None],
        on_loss: Callable[[str], None],
    ) -> None:
        self._bus = bus
        self._url = url
        self._on_frame = on_frame
        self._on_loss = on_loss
        self._loop = asyncio.get_running_loop()
        self._is_lost = False
        self._closing = threading.Event()
        self._sending = threading.Lock()
        self._thread = threading.Thread(target=self._read, name=f"era-can {url}", daemon=True)
        self._thread.start()

    def send(self, frames: Sequence[CanFrame]) -> int:
        """Send frames back to back, as many as the adapter takes; returns them, or LinkError."""
        try:
            with self._sending:
                taken = send_some(self._bus, frames)
                is_clear = flush(self._bus)
        except _CAN_ERRORS as problem:
            cause = self._loss_message(problem)
            self._loop.call_soon_threadsafe(self._lose, cause)
            raise LinkError(cause) from problem
        if not is_clear:
            self._loop.call_soon_threadsafe(self._loop.call_later, FULL_PAUSE, self._flush)
        return taken

    def _flush(self) -> None:
        """Send what is left of a frame; the loss of the bus is reported by `_lose`."""
        if not self._closing.is_set():
            with contextlib.suppress(LinkError):
                self.send(())

    def close(self) -> None:
        """Let the reader end, which closes the adapter."""
        self._closing.set()
        wake(self._bus)

    async def wait_closed(self) -> None:
        """Wait until it is closed, but not for an adapter that hangs."""
        await close_in_thread(self._thread.join, name=f"era-close {self._url}")

    def _read(self) -> None:
        """Read until the bus is closed or lost, then close it; reader thread."""
        problem: Exception | str = ""
        try:
            while not self._closing.is_set() and not problem:
                message = self._bus.recv(timeout=_READ_TIMEOUT)
                # A closed adapter may hang here while others have reopened the bus.
                if message is not None and not self._closing.is_set():
                    problem = self._received(message)
        except _CAN_ERRORS as error:
            problem = error
        finally:
            _shut(self._bus)
        if not self._closing.is_set():
            with contextlib.suppress(RuntimeError):  # of a closed loop
                self._loop.call_soon_threadsafe(self._lose, self._loss_message(problem))

    def _received(self, message: can.Message) -> str:
        """Pass a frame on; returns the problem that an error frame reports, if any."""
        if message.is_error_frame:
            return _BUS_OFF_MESSAGE if message.arbitration_id & _BUS_OFF else ""
        if not (message.is_remote_frame or message.is_extended_id):
            data = bytes(message.data)
            self._on_frame(CanFrame(message.arbitration_id, data, fd=message.is_fd))
        return ""

    def _lose(self, cause: str) -> None:
        if self._is_lost or self._closing.is_set():
            return
        self._is_lost = True
        self.close()
        self._on_loss(cause)

    def _loss_message(self, problem: Exception | str) -> str:
        return (
            f"the CAN bus {self._url} was lost ({problem}): check the adapter and the cable, then "
            "open the amplifier again"
        )


def _shut(bus: can.BusABC) -> None:
    """Close an adapter, also a lost one."""
    with contextlib.suppress(*_CAN_ERRORS):
        bus.shutdown()


def _open_error_message(url: CanBusUrl, problem: Exception) -> str:
    if url.interface == "slcan":
        remedy = remedy_of(problem) or "check the port's name, the adapter and the bit rate"
    elif url.interface == "socketcand":
        remedy = "check address and port, and that socketcand serves this bus there"
    elif url.interface == "socketcan":
        remedy = (
            f"check that the interface exists (ip link) and is up: sudo ip link set {url.channel} "
            f"up type can bitrate {url.bitrate}"
        )
    else:
        remedy = "check its name, and that the driver of its vendor is installed"
    return f"CAN bus {url} cannot be opened: {remedy} (the system says: {system_message(problem)})"
