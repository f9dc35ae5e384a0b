"""An open bus of python-can as a port of packed frames."""

import asyncio
import contextlib
import errno
import logging
import threading
import time
from collections.abc import Callable
from typing import Any, final

import can

from drivers.codec.can_bus.canopen import CanFrame
from drivers.codec.can_bus.segments import REQUEST, pack_frames, unpack_frames
from drivers.errors import LinkError, system_message
from drivers.threads import close_in_thread, in_thread
from drivers.urls.can_bus import CanBusUrl

_WATCHED = ("socketcan", "udp_multicast")
"""Interfaces whose file descriptor the event loop watches: `recv` of the others may block."""

_READ_TIMEOUT = 0.05  # s; interval in which a reader thread notices its end
_READS = 64  # frames at once, so that a flood does not keep the event loop
_BUS_OFF = 0x40  # error class of SocketCAN
_FULL = "Transmit buffer full"  # of python-can, if the socket's buffer is full
_FULL_PAUSE = 0.0005  # s; before frames are sent again to a full transmit queue
_FULL_TIMEOUT = 0.03  # s; without progress, after which frames are dropped as too old
_CAN_ERRORS = (can.CanError, OSError, ValueError, TypeError)  # TypeError: closed during a read

logging.getLogger("can").addHandler(logging.NullHandler())  # its messages become LinkErrors


async def open_bus(
    url: CanBusUrl, on_data: Callable[[bytes], None], on_loss: Callable[[str], None]
) -> "BusPort":
    """Open a bus; raises LinkError. See `BusPort`."""
    try:
        bus = await in_thread(lambda: _open_bus(url), name=f"era-open {url}", undo=_shut)
    except Exception as problem:  # of the drivers of many vendors
        raise LinkError(_why_not_open(url, problem)) from problem
    return BusPort(bus, url.interface in _WATCHED, str(url), on_data, on_loss)


@final
class BusPort:
    """A bus of python-can, read by the event loop where it is watched, or by a thread.

    on_data: called with packed frames. Implements `Port`. Of frames that the adapter has not taken
    yet newer ones replace the older, whose request was given up; broadcasts stay, which have no
    reply to wait for.
    """

    def __init__(
        self,
        bus: can.BusABC,
        is_watched: bool,
        name: str,
        on_data: Callable[[bytes], None],
        on_loss: Callable[[str], None],
    ) -> None:
        self._bus, self._name = bus, name
        self._on_data, self._on_loss = on_data, on_loss
        self._loop = asyncio.get_running_loop()
        self._unsent: list[CanFrame] = []
        self._given_up_at = 0.0
        self._is_full = False
        self._timer: asyncio.TimerHandle | None = None
        self._is_lost = False
        self._closing = threading.Event()
        self._descriptor = bus.fileno() if is_watched else None
        self._thread: threading.Thread | None = None
        if self._descriptor is not None:
            self._loop.add_reader(self._descriptor, self.poll)
            return
        self._thread = threading.Thread(target=self._read, name=f"era-can {name}", daemon=True)
        self._thread.start()

    @property
    def is_blocked(self) -> bool:
        """Whether the adapter has not taken all frames yet."""
        return self._is_full

    def write(self, data: bytes) -> None:
        """Send frames, as soon as the adapter takes them; raises LinkError."""
        kept = [frame for frame in self._unsent if frame.id == REQUEST]
        self._unsent = [*kept, *unpack_frames(data)]
        self._given_up_at = self._loop.time() + _FULL_TIMEOUT
        self._send()

    def poll(self) -> None:
        """Hand over what has come and was not read yet; a reader thread has done so."""
        if self._descriptor is None:
            return
        frames: list[CanFrame] = []
        problem: Exception | str = ""
        try:
            for _ in range(_READS):
                message = self._bus.recv(timeout=0)
                if message is None:
                    break
                problem = problem or _problem(message)
                frames += _frames(message)
        except _CAN_ERRORS as error:
            problem = error
        if frames:
            self._on_data(pack_frames(frames))
        if problem:
            self._lose(problem)

    def close(self) -> None:
        """Stop reading and writing; `wait_closed` closes the bus."""
        self._closing.set()
        self._unsent.clear()
        watched, self._descriptor = self._descriptor, None
        if watched is not None:
            self._loop.remove_reader(watched)

    async def wait_closed(self) -> None:
        """Wait until the bus is closed, but not for an adapter that hangs."""
        await close_in_thread(self._close_bus, name=f"era-close {self._name}")

    def _close_bus(self) -> None:
        if self._thread is not None:
            self._thread.join()
        _shut(self._bus)

    def _send(self) -> None:
        """Send frames until the adapter takes no more, then again after a pause."""
        try:
            while self._unsent:
                self._is_full = not self._take(self._unsent[0])
                if self._is_full:
                    break
                del self._unsent[0]
                self._given_up_at = self._loop.time() + _FULL_TIMEOUT
        except _CAN_ERRORS as error:
            self._lose(error)
            raise LinkError(self._loss_message(error)) from error
        if self._loop.time() > self._given_up_at:
            self._unsent.clear()
        if self._unsent and self._timer is None:
            self._timer = self._loop.call_later(_FULL_PAUSE, self._send_again)

    def _take(self, frame: CanFrame) -> bool:
        """Send a frame; returns whether the adapter has taken it."""
        message = can.Message(
            arbitration_id=frame.id,
            is_extended_id=False,
            data=frame.data,
            timestamp=time.time(),
        )
        try:
            self._bus.send(message)
        except can.CanOperationError as error:
            if error.error_code == errno.ENOBUFS or _FULL in str(error):
                return False
            raise
        return True

    def _send_again(self) -> None:
        self._timer = None
        if not self._closing.is_set():
            with contextlib.suppress(LinkError):  # reported by _lose
                self._send()

    def _read(self) -> None:
        """Read until the bus is closed or lost; reader thread."""
        problem: Exception | str = ""
        post = self._loop.call_soon_threadsafe
        with contextlib.suppress(RuntimeError):  # of a closed loop
            try:
                while not self._closing.is_set() and not problem:
                    message = self._bus.recv(timeout=_READ_TIMEOUT)
                    if message is not None:
                        problem = _problem(message)
                        post(self._received, pack_frames(_frames(message)))
            except _CAN_ERRORS as error:
                problem = error
            if problem:
                post(self._lose, problem)

    def _received(self, data: bytes) -> None:
        if data and not self._closing.is_set():
            self._on_data(data)

    def _lose(self, problem: Exception | str) -> None:
        if self._is_lost or self._closing.is_set():
            return
        self._is_lost = True
        self.close()
        self._on_loss(self._loss_message(problem))

    def _loss_message(self, problem: Exception | str) -> str:
        return (
            f"the CAN bus {self._name} was lost ({problem}): check the adapter and the cable, then "
            "open the amplifier again"
        )


def _problem(message: can.Message) -> str:
    """Return the problem that an error frame reports, if any."""
    if message.is_error_frame and message.arbitration_id & _BUS_OFF:
        return "the adapter went bus-off; check wiring, termination and bit rate"
    return ""


def _frames(message: can.Message) -> list[CanFrame]:
    """Return the data frame with an 11-bit identifier that a message is, if it is one."""
    if message.is_error_frame or message.is_remote_frame or message.is_extended_id:
        return []
    data = bytes(message.data)
    return [CanFrame(message.arbitration_id, data)] if not message.is_fd else []


def _open_bus(url: CanBusUrl) -> can.BusABC:
    """Open the adapter to a bus; raises whatever its driver raises."""
    if url.interface == "socketcan":
        # The bit rate is set with: ip link set can0 type can bitrate 500000.
        return can.Bus(interface="socketcan", channel=url.channel, ignore_config=True)
    options: dict[str, Any] = {name: can.util.cast_from_string(text) for name, text in url.options}
    return can.Bus(
        interface=url.interface,
        channel=int(url.channel) if url.channel.isdecimal() else url.channel,
        ignore_config=True,
        bitrate=url.bitrate,
        receive_own_messages=False,
        **options,
    )


def _shut(bus: can.BusABC) -> None:
    """Close an adapter, also a lost one."""
    with contextlib.suppress(*_CAN_ERRORS):
        bus.shutdown()


def _why_not_open(url: CanBusUrl, problem: Exception) -> str:
    if url.interface == "socketcan":
        remedy = (
            f"check that the interface exists (ip link) and is up: sudo ip link set {url.channel} "
            f"up type can bitrate {url.bitrate}"
        )
    else:
        remedy = "check its name, and that the driver of its vendor is installed"
    return f"CAN bus {url} cannot be opened: {remedy} (the system says: {system_message(problem)})"
