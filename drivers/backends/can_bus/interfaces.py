"""Adapters to CAN as python-can knows them, made fit for a bus that may go away or talk nonsense.

python-can's socketcand never notices that its server has hung up, waits for ever for one that says
nothing, and both it and slcan stumble for ever over text that makes no frame. So their text is read
here (see `drivers.codec.can_bus.adapter_text`) and the frames of a request are written at once.
"""

import contextlib
import re
import select
import socket
import time
from abc import abstractmethod
from collections import deque
from collections.abc import Iterable, Sequence

import can
from can.interfaces.slcan import slcanBus
from can.interfaces.virtual import VirtualBus

from drivers.backends.ports.writing import write_all
from drivers.backends.urls.can_bus import CanBusUrl
from drivers.codec.can_bus.adapter_text import (
    SlcanReader,
    SocketcandReader,
    slcan_line,
    socketcand_element,
)
from drivers.codec.can_bus.frame import CanFrame

_SEND_TIMEOUT = 0.02  # s; a frame fits into any driver's buffer unless the bus is stuck
_SERIAL_TIMEOUT = 0.05  # s; how long a read of the serial port waits
_CONNECT_TIMEOUT = 2.0  # s
_READ_MAX = 4096
_HANDSHAKE = (("", b"< hi"), ("< open {channel} >", b"< ok"), ("< rawmode >", b"< ok"))
_IS_FRAME = re.compile(rb"\s*< (fd)?frame ")


def open_bus(url: CanBusUrl) -> can.BusABC:
    """The adapter to a bus, open; raises can.CanError, OSError or ValueError."""
    match url.interface:
        case "socketcand":
            return _Socketcand(url)
        case "slcan":
            return _Slcan(url)
        case "socketcan":
            # The bit rate is the interface's own: ip link set can0 type can bitrate 500000.
            return can.Bus(
                interface="socketcan", channel=url.channel, fd=bool(url.fd), ignore_config=True
            )
        case _:
            return can.Bus(interface=url.interface, channel=url.channel, ignore_config=True)


def send_all(bus: can.BusABC, frames: Sequence[CanFrame]) -> None:
    """Send frames one after the other; raises can.CanError or OSError."""
    if isinstance(bus, _Socketcand | _Slcan):
        bus.send_frames(frames)
        return
    for frame in frames:
        bus.send(_message(frame), timeout=_SEND_TIMEOUT)


def wake(bus: can.BusABC) -> None:
    """Let a thread that waits in `recv` return or fail soon, where the adapter can."""
    if isinstance(bus, _Socketcand | _Slcan):
        bus.wake()
    elif isinstance(bus, VirtualBus):
        bus.queue.put(can.Message(is_error_frame=True))  # which says nothing


class _TextBus(can.BusABC):
    """A bus whose frames are text."""

    def _begin(self) -> None:
        self._messages: deque[can.Message] = deque()

    def _take(self, frames: Iterable[CanFrame]) -> None:
        self._messages.extend(map(_message, frames))

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        if not self._messages:
            self._read_text(timeout)
        return (self._messages.popleft() if self._messages else None), False

    @abstractmethod
    def _read_text(self, timeout: float | None) -> None:
        """Wait for text for so long [s] and take it."""


class _Socketcand(_TextBus):
    """A server of the socketcand daemon."""

    def __init__(self, url: CanBusUrl) -> None:
        self._begin()
        self._reader = SocketcandReader()
        self.channel_info = f"socketcand on {url.channel}@{url.host}:{url.port}"
        self._connection = socket.create_connection((url.host, url.port), timeout=_CONNECT_TIMEOUT)
        try:
            self._connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._shake_hands(url.channel)
            # Nobody reads without waiting for a byte first, so this only limits how long sending
            # takes.
            self._connection.settimeout(_SEND_TIMEOUT)
            can.BusABC.__init__(self, channel=url.channel)
        except BaseException:
            self._connection.close()
            raise

    def _shake_hands(self, channel: str) -> None:
        """Open the bus there, in raw mode; frames may come as soon as the server says hi."""
        text = b""
        for say, expected in _HANDSHAKE:
            self._connection.sendall(say.format(channel=channel).encode())
            element, text = self._element(text)
            while _IS_FRAME.match(element):
                element, text = self._element(text)
            if element.strip() != expected:
                raise can.CanInitializationError(f"instead of {expected!r} it says {element!r}")
        self._take(self._reader.feed(text))

    def _element(self, text: bytes) -> tuple[bytes, bytes]:
        """The next element that the server says, without its end, and what follows it."""
        deadline = time.monotonic() + _CONNECT_TIMEOUT
        while b">" not in text:
            data = self._connection.recv(_READ_MAX)
            text += data
            if not data or len(text) > _READ_MAX or time.monotonic() > deadline:
                raise can.CanInitializationError(f"no socketcand server says {text!r}")
        element, _, rest = text.partition(b">")
        return element, rest

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Send one; see `send_frames`."""
        self.send_frames([CanFrame(msg.arbitration_id, bytes(msg.data), fd=msg.is_fd)])

    def shutdown(self) -> None:
        """Close the connection."""
        super().shutdown()
        self._connection.close()

    def wake(self) -> None:
        """End the connection."""
        with contextlib.suppress(OSError):
            self._connection.shutdown(socket.SHUT_RDWR)

    def send_frames(self, frames: Sequence[CanFrame]) -> None:
        """Send all at once."""
        self._connection.sendall(b"".join(map(socketcand_element, frames)))

    def _read_text(self, timeout: float | None) -> None:
        if select.select([self._connection], [], [], timeout)[0]:
            data = self._connection.recv(_READ_MAX)
            if not data:
                raise can.CanOperationError("the socketcand server hung up")
            self._take(self._reader.feed(data))


class _Slcan(_TextBus, slcanBus):
    """A serial adapter, its port for this process alone."""

    def __init__(self, url: CanBusUrl) -> None:
        self._begin()
        self._reader = SlcanReader()
        self._is_ended = False
        self._is_cut = False
        slcanBus.__init__(
            self,
            url.channel,
            tty_baudrate=url.baud,
            bitrate=None if url.fd else url.bitrate,
            sleep_after_open=0.0,
            timeout=_SERIAL_TIMEOUT,
        )
        try:
            self.serialPortOrig.write_timeout = _SEND_TIMEOUT
            self.serialPortOrig.exclusive = True
            if url.fd:
                self.set_bitrate(url.bitrate, url.fd)
        except BaseException:
            self.shutdown()
            raise

    def wake(self) -> None:
        """End a read that waits, for good."""
        self._is_ended = True
        with contextlib.suppress(OSError, AttributeError):
            self.serialPortOrig.cancel_read()

    def shutdown(self) -> None:
        """Close channel and port, also where the adapter is gone."""
        with contextlib.suppress(can.CanError, OSError):
            slcanBus.shutdown(self)
        with contextlib.suppress(OSError):
            self.serialPortOrig.close()

    def send_frames(self, frames: Sequence[CanFrame]) -> None:
        """Send all at once, without python-can's wait until the last byte is out."""
        begin = b"\r" if self._is_cut else b""  # so that what was left half sent ends here
        self._is_cut = True
        write_all(self.serialPortOrig, begin + b"".join(map(slcan_line, frames)))
        self._is_cut = False

    def _read_text(self, timeout: float | None) -> None:
        port = self.serialPortOrig
        self._take(self._reader.feed(port.read(max(1, port.in_waiting))))
        if self._is_ended:
            raise can.CanOperationError("the adapter is being closed")


def _message(frame: CanFrame) -> can.Message:
    return can.Message(
        arbitration_id=frame.id,
        is_extended_id=False,
        is_fd=frame.fd,
        bitrate_switch=frame.fd,
        data=frame.data,
        timestamp=time.time(),
    )
