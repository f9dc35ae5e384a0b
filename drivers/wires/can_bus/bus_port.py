"""An open bus of python-can as a port of packed frames."""

import asyncio
import contextlib
import errno
import logging
import time
from collections.abc import Callable, Mapping
from typing import Any, final

import can

from drivers.errors import LinkError, system_message
from drivers.ports import FAILURES, DevicePort
from drivers.wires.can_bus.canopen import ERROR_ID, CanFrame
from drivers.wires.can_bus.frames import REQUEST, pack_frames, unpack_frames
from registry.threads import in_thread

_WATCHED = ("socketcan", "udp_multicast")
"""Interfaces whose file descriptor the event loop watches: `recv` of the others may block."""

_READ_TIMEOUT = 0.05  # s; interval in which a reader thread notices its end
_READS = 64  # frames at once, so that a flood does not keep the event loop
_BUS_OFF = 0x40  # error class of SocketCAN
_FULL = "Transmit buffer full"  # of python-can, if the socket's buffer is full
_FULL_PAUSE = 0.0005  # s; before frames are sent again to a full transmit queue
_FULL_TIMEOUT = 0.03  # s; without progress, after which frames are dropped as too old

logging.getLogger("can").addHandler(logging.NullHandler())  # its messages become LinkErrors


async def open_bus(
    name: str,
    bus: Mapping[str, Any],
    on_data: Callable[[bytes], None],
    on_loss: Callable[[str], None],
) -> "BusPort":
    """Open a bus by the arguments of `can.Bus`; raises LinkError. See `BusPort`."""
    try:
        opened = await in_thread(
            lambda: can.Bus(ignore_config=True, **bus), name=f"era-open {name}", undo=_shut
        )
    except Exception as problem:  # of the drivers of many vendors
        remedy = "check its name, and that the driver of its vendor is installed"
        if bus["interface"] == "socketcan":
            remedy = (
                "check that the interface exists (ip link) and is up: sudo ip link set "
                f"{bus['channel']} up type can bitrate {bus['bitrate']}"
            )
        raise LinkError(
            f"CAN bus {name} cannot be opened: {remedy} (the system says: "
            f"{system_message(problem)})"
        ) from problem
    return BusPort(opened, bus["interface"] in _WATCHED, name, on_data, on_loss)


@final
class BusPort(DevicePort):
    """A bus of python-can, read by the event loop where it is watched, or by a thread.

    on_data: called with packed frames. Implements `Port`. Of frames that the adapter has not taken
    yet newer ones replace the older, whose request was given up; broadcasts, which have no
    reply to wait for, stay for as long as a request would.
    """

    kind = "CAN bus"
    failures = (*FAILURES, can.CanError)

    def __init__(
        self,
        bus: can.BusABC,
        is_watched: bool,
        name: str,
        on_data: Callable[[bytes], None],
        on_loss: Callable[[str], None],
    ) -> None:
        self._bus = bus
        self._unsent: list[tuple[CanFrame, float]] = []  # until when [s] a broadcast may be sent
        self._given_up_at = 0.0
        self._is_full = False
        self._timer: asyncio.TimerHandle | None = None
        super().__init__(name, bus.fileno() if is_watched else None, on_data, on_loss, bus.shutdown)

    @property
    def is_blocked(self) -> bool:
        """Whether the adapter has not taken all frames yet."""
        return self._is_full

    def write(self, data: bytes) -> None:
        """Send frames, as soon as the adapter takes them; raises LinkError."""
        kept = [each for each in self._unsent if each[0].id == REQUEST]
        self._given_up_at = until = self.loop.time() + _FULL_TIMEOUT
        self._unsent = [*kept, *[(frame, until) for frame in unpack_frames(data)]]
        self._send()

    def read_watched(self) -> bytes:
        """Return the frames that have come."""
        frames: list[CanFrame] = []
        try:
            for _ in range(_READS):
                message = self._bus.recv(timeout=0)
                if message is None:
                    break
                frames += _frames(message)
        except self.failures:
            self.received(pack_frames(frames))
            raise
        return pack_frames(frames)

    def read_waiting(self) -> bytes:
        """Return the frame that comes within a short time."""
        message = self._bus.recv(timeout=_READ_TIMEOUT)
        return b"" if message is None else pack_frames(_frames(message))

    def close(self) -> None:
        """Stop reading and writing; `wait_closed` closes the bus."""
        self._unsent.clear()
        super().close()

    def _send(self) -> None:
        """Send frames until the adapter takes no more, then again after a pause."""
        now = self.loop.time()
        self._unsent = [each for each in self._unsent if each[0].id != REQUEST or now <= each[1]]
        try:
            while self._unsent:
                self._is_full = not self._take(self._unsent[0][0])
                if self._is_full:
                    break
                del self._unsent[0]
                self._given_up_at = self.loop.time() + _FULL_TIMEOUT
        except self.failures as error:
            raise self.lose(error) from error
        if self.loop.time() > self._given_up_at:
            self._unsent.clear()
        if self._unsent and self._timer is None:
            self._timer = self.loop.call_later(_FULL_PAUSE, self._send_again)

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
        if not self.closing.is_set():
            with contextlib.suppress(LinkError):  # reported as a loss
                self._send()


def _frames(message: can.Message) -> list[CanFrame]:
    """Return the data frame with an 11-bit identifier that a message is, if it is one.

    Of an error frame its class is reported; OSError for one that says that the adapter is off the
    bus.
    """
    if message.is_error_frame and message.arbitration_id & _BUS_OFF:
        raise OSError("the adapter went bus-off; check wiring, termination and bit rate")
    if message.is_error_frame:
        return [CanFrame(ERROR_ID, bytes([message.arbitration_id & 0xFF]))]
    if message.is_remote_frame or message.is_extended_id:
        return []
    return [] if message.is_fd else [CanFrame(message.arbitration_id, bytes(message.data))]


def _shut(bus: can.BusABC) -> None:
    """Close an adapter that is not used."""
    with contextlib.suppress(*BusPort.failures):
        bus.shutdown()
