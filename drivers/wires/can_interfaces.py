"""CAN buses of python-can's interfaces: their port and their URLs.

    can+socketcan://can0#NODE
    can+python-can://INTERFACE/CHANNEL?bitrate=500000#NODE

An adapter may take no frames for a while: `Outbox` keeps the frames that `BusPort` has not sent.
"""

import asyncio
import contextlib
import errno
import logging
import re
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar, final

import can

from drivers.errors import LinkError, system_message
from drivers.ports import FAILURES, DevicePort, Port
from drivers.urls import AmplifierUrl
from drivers.wires.can_bus import NODE_FORM, NODE_RANGE, CanAddress
from drivers.wires.can_frames import ERROR_ID, REQUEST, CanFrame, pack_frames, unpack_frames
from drivers.wires.wire import Scheme
from registry.threads import in_thread


@dataclass(frozen=True, slots=True)
class Interface:
    """What an interface of python-can does in its own way."""

    is_watched: bool = False
    """Whether it has a file descriptor for the event loop: `recv` of the others may block."""
    sends_at_once: bool = False
    """Whether its `send` never blocks without a timeout."""
    full_code: int | None = None
    """Code of the error that `send` raises for a full transmit queue; None without a code."""
    bus_off: int = 0
    """Bit of an error frame's identifier that reports bus-off; 0 without one."""


_BUS_OFF = 0x40  # CAN_ERR_BUSOFF of linux/can/error.h
_INTERFACES: Mapping[str, Interface] = {
    "socketcan": Interface(
        is_watched=True, sends_at_once=True, full_code=errno.ENOBUFS, bus_off=_BUS_OFF
    ),
    "udp_multicast": Interface(is_watched=True),
    "gs_usb": Interface(bus_off=_BUS_OFF),  # its protocol is that of the driver of Linux
    "kvaser": Interface(full_code=-13),  # canERR_TXBUFOFL
    "systec": Interface(full_code=11),  # USBCAN_ERR_DLL_TXFULL
    "usb2can": Interface(full_code=9),  # CANAL_ERROR_FIFO_FULL
    "vector": Interface(full_code=11),  # XL_ERR_QUEUE_IS_FULL
}
"""Interfaces that differ from the default."""
_FULL = re.compile(r"transmit (queue|buffer)\b.*\bfull", re.IGNORECASE)
"""Text for a full queue without a code: of SocketCAN, and of PCAN's library in English."""

_READ_TIMEOUT = 0.05  # s; interval in which a reader thread notices its end
_READS = 64  # frames per iteration, so that a flood does not block the event loop
_FULL_PAUSE = 0.0005  # s; before frames are sent again to a full transmit queue
FULL_TIMEOUT = 0.03  # s; without progress, after which frames are dropped as too old

logging.getLogger("can").addHandler(logging.NullHandler())  # its messages become LinkErrors
_PYTHON_CAN_FORM = (
    "can+socketcan://can0#NODE or can+python-can://INTERFACE/CHANNEL?bitrate=500000#NODE"
)
_OTHERS = ("slcan", "socketcan", "socketcand")
"""Interfaces with a URL scheme of their own."""
_OPTIONS = {  # of python-can, passed on as they are: which of several adapters it is
    "canalystii": ("device",),
    "ixxat": ("unique_hardware_id",),
    "neousys": ("device",),
    "neovi": ("serial",),
    "pcan": ("device_id",),
    "systec": ("device_number",),
    "udp_multicast": ("port",),
    "vector": ("app_name", "serial"),
}


async def open_bus(
    name: str,
    bus: Mapping[str, Any],
    on_data: Callable[[bytes], None],
    on_loss: Callable[[str], None],
) -> "BusPort":
    """Open a bus by the arguments of `can.Bus`; raises LinkError. See `BusPort`."""
    try:
        opened = await in_thread(
            partial(can.Bus, ignore_config=True, **bus), name=f"era-open {name}", undo=_shut
        )
    except Exception as problem:  # of the drivers of many vendors
        remedy = "check its name, and that the driver of its vendor is installed"
        if bus["interface"] == "socketcan":
            remedy = (
                "check that the interface exists (ip link) and is up: sudo ip link set "
                f"{bus['channel']} up type can bitrate {bus['bitrate']}"
            )
        raise LinkError(
            f"CAN bus {name} cannot be opened: {remedy} (system error: {system_message(problem)})"
        ) from problem
    interface = _INTERFACES.get(bus["interface"], Interface())
    return BusPort(opened, name, on_data, on_loss, interface)


class Outbox:
    """Frames that an adapter has not taken yet; times [s] are arguments.

    Newer frames replace older ones, whose request was given up. Broadcasts, which have no reply to
    wait for, stay for as long as a request would. Frames that make no progress for 30 ms are
    dropped as too old.
    """

    def __init__(self) -> None:
        self._frames: deque[tuple[CanFrame, float]] = deque()  # with the expiry [s] of a broadcast
        self._given_up_at = 0.0

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self._frames)

    def put(self, frames: Iterable[CanFrame], now: float) -> None:
        """Add the frames of a request in place of all others but broadcasts."""
        self._given_up_at = now + FULL_TIMEOUT
        broadcasts = [entry for entry in self._frames if entry[0].id == REQUEST]
        added = [(frame, self._given_up_at) for frame in frames]
        self._frames = deque([*broadcasts, *added])

    def first(self, now: float) -> CanFrame | None:
        """Return the next frame to send, without frames that are too old; None without any."""
        if now > self._given_up_at:
            self._frames.clear()
        while self._frames:
            frame, expires_at = self._frames[0]
            if frame.id != REQUEST or now <= expires_at:
                return frame
            self._frames.popleft()
        return None

    def taken(self, frame: CanFrame, now: float) -> None:
        """Note that the adapter has taken a frame, unless a newer request has replaced it."""
        if self._frames and self._frames[0][0] is frame:
            self._frames.popleft()
            if now <= self._given_up_at:
                self._given_up_at = now + FULL_TIMEOUT

    def clear(self) -> None:
        """Drop all frames."""
        self._frames.clear()


@final
class BusPort(DevicePort):
    """A bus of python-can; implements `Port`.

    The event loop watches the bus, and sends frames, where the interface allows it; otherwise
    threads do, so that an adapter that hangs delays neither a stop on another line nor a heartbeat.
    on_data: called with packed frames.
    """

    kind = "CAN bus"
    failures = (*FAILURES, can.CanError)

    def __init__(
        self,
        bus: can.BusABC,
        name: str,
        on_data: Callable[[bytes], None],
        on_loss: Callable[[str], None],
        interface: Interface,
    ) -> None:
        self._bus = bus
        self._interface = interface
        self.outbox = Outbox()
        self._outbox_changed = threading.Condition()  # its lock guards the outbox
        self._is_blocked = False
        self._timer: asyncio.TimerHandle | None = None
        descriptor = bus.fileno() if interface.is_watched else None
        super().__init__(name, descriptor, on_data, on_loss, bus.shutdown)
        if not interface.sends_at_once:
            self.start_thread(self._send_in_thread, name=f"era-send {name}")

    @property
    def is_blocked(self) -> bool:
        """Whether the adapter has not taken the frame that was given to it last."""
        return self._is_blocked

    def write(self, data: bytes) -> None:
        """Send frames, as soon as the adapter takes them; raises LinkError."""
        if self.closing.is_set():
            raise self.lose(OSError("it is closed"))
        with self._outbox_changed:
            self.outbox.put(unpack_frames(data), self.loop.time())
            self._outbox_changed.notify()
        if self._interface.sends_at_once:
            self._send()

    def read_watched(self) -> bytes:
        """Return the frames that have come."""
        frames: list[CanFrame] = []
        try:
            for _ in range(_READS):
                message = self._bus.recv(timeout=0)
                if message is None:
                    break
                frames += self._frames(message)
        except self.failures:
            self.received(pack_frames(frames))
            raise
        return pack_frames(frames)

    def read_waiting(self) -> bytes:
        """Return the frame that comes within a short time."""
        message = self._bus.recv(timeout=_READ_TIMEOUT)
        return b"" if message is None else pack_frames(self._frames(message))

    def close(self) -> None:
        """Stop reading and writing; `wait_closed` closes the bus."""
        with self._outbox_changed:
            self.outbox.clear()
            super().close()
            self._outbox_changed.notify()

    def _send(self) -> None:
        """Send frames until the adapter takes no more, then again after a pause."""
        try:
            frame = self.outbox.first(self.loop.time())
            while frame is not None and self._take(frame):
                self.outbox.taken(frame, self.loop.time())
                frame = self.outbox.first(self.loop.time())
        except self.failures as error:
            raise self.lose(error) from error
        if self.outbox and self._timer is None:
            self._timer = self.loop.call_later(_FULL_PAUSE, self._send_again)

    def _send_again(self) -> None:
        """Send the frames that the adapter has not taken."""
        self._timer = None
        if not self.closing.is_set():
            with contextlib.suppress(LinkError):  # reported as a loss
                self._send()

    def _send_in_thread(self) -> None:
        """Send frames as they come, each as soon as the adapter has taken the last one."""
        while True:
            with self._outbox_changed:
                frame = self.outbox.first(self.loop.time())
                while frame is None and not self.closing.is_set():
                    self._outbox_changed.wait()
                    frame = self.outbox.first(self.loop.time())
                if frame is None or self.closing.is_set():
                    return
            is_taken = self._take(frame)  # without the lock: it may block
            with self._outbox_changed:
                if is_taken:
                    self.outbox.taken(frame, self.loop.time())
                else:
                    self._outbox_changed.wait(_FULL_PAUSE)

    def _take(self, frame: CanFrame) -> bool:
        """Give a frame to the adapter; returns whether it has taken it."""
        self._is_blocked = True
        message = can.Message(
            arbitration_id=frame.id,
            is_extended_id=False,
            data=frame.data,
            timestamp=time.time(),
        )
        try:
            self._bus.send(message)
        except can.CanError as error:
            if self._is_full(error):
                return False
            raise
        self._is_blocked = False
        return True

    def _is_full(self, error: can.CanError) -> bool:
        """Whether an error of `send` reports a full transmit queue."""
        code = error.error_code
        if code is None:  # systec: in the cause
            code = getattr(error.__cause__, "error_code", None)
        if code is not None and code == self._interface.full_code:
            return True
        return isinstance(error, can.CanTimeoutError) or _FULL.search(str(error)) is not None

    def _frames(self, message: can.Message) -> list[CanFrame]:
        """Return the data frame with an 11-bit identifier that a message is, if it is one.

        For an error frame, its class is reported; OSError if the adapter is off the bus.
        """
        if message.is_error_frame and message.arbitration_id & self._interface.bus_off:
            raise OSError("the adapter went bus-off; check wiring, termination and bit rate")
        if message.is_error_frame:
            return [CanFrame(ERROR_ID, bytes([message.arbitration_id & 0xFF]))]
        if message.is_remote_frame or message.is_extended_id or message.is_fd:
            return []
        return [CanFrame(message.arbitration_id, bytes(message.data))]


def _shut(bus: can.BusABC) -> None:
    """Close an adapter that is not used."""
    with contextlib.suppress(*BusPort.failures):
        bus.shutdown()


class PythonCanAddress(CanAddress):
    """A node on a bus of a python-can interface.

    bus: arguments of `can.Bus`.
    """

    SCHEMES: ClassVar[Mapping[str, Scheme]] = {
        "can+socketcan": Scheme(
            line_kind="can",
            example="can+socketcan://can0#NODE",
            help="CAN on a network interface",
            number=NODE_RANGE,
            forms={
                "can+socketcan://INTERFACE#NODE": "`bitrate` 500000; must match the setting of "
                "`ip link`"
            },
        ),
        "can+python-can": Scheme(
            line_kind="can",
            example="can+python-can://INTERFACE/CHANNEL#NODE",
            help="CAN on any other interface of python-can",
            number=NODE_RANGE,
            forms={
                "can+python-can://INTERFACE/CHANNEL#NODE": "`bitrate` 500000; to select an "
                "adapter: `device` (canalystii, neousys), `unique_hardware_id` (ixxat), `serial` "
                "(neovi, vector), `device_id` (pcan), `device_number` (systec), `port` "
                "(udp_multicast), `app_name` (vector)"
            },
        ),
    }

    def __init__(self, url: str) -> None:
        interface = url.partition("://")[2].partition("/")[0]
        options = _OPTIONS.get(interface, ())
        parsed = AmplifierUrl(url, _PYTHON_CAN_FORM, known=("bitrate", *options))
        if parsed.scheme == "can+socketcan":
            interface, channel = "socketcan", parsed.place
            parsed.check_path(parsed.path, NODE_FORM)
        else:
            channel = parsed.path.removeprefix("/")
            parsed.require(
                interface not in ("", *_OTHERS),
                f"interface must be one of python-can, got {interface!r}",
            )
        parsed.require(bool(channel.strip("/")), "bus must be given")
        chosen = {}
        for name in options:
            if name in parsed.options:
                chosen[name] = _number_or_text(parsed.options[name])
        where = f"{parsed.place}/{parsed.path.strip('/')}".strip("/")
        super().__init__(parsed, f"{parsed.scheme}://{where}", settings=chosen)
        self.bus: dict[str, Any] = {
            "interface": interface,
            "channel": _number_or_text(channel),
            "bitrate": self.bitrate,  # not of SocketCAN: ip link set can0 type can bitrate 500000
            "receive_own_messages": False,
            **chosen,
        }

    async def open_port(
        self, on_data: Callable[[bytes], None], on_loss: Callable[[str], None]
    ) -> Port:
        """Open the bus; raises LinkError."""
        return await open_bus(self.line, self.bus, on_data, on_loss)


def _number_or_text(text: str) -> int | str:
    return int(text) if text.isdecimal() else text
