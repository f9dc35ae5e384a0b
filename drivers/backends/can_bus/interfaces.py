"""CAN adapters of python-can, made robust against lost servers and invalid text.

python-can's socketcand does not detect a closed connection, waits indefinitely for a silent server,
and fails permanently on invalid text, as slcan does. Their text is parsed here (see
`drivers.codec.can_bus.adapter_text`), and the frames of a request are written at once.
"""

import contextlib
import errno
import os
import re
import select
import socket
import time
from abc import abstractmethod
from collections import deque
from collections.abc import Iterable, Sequence
from typing import Any

import can
from can.interfaces.slcan import slcanBus
from can.interfaces.virtual import VirtualBus

from drivers.codec.can_bus.adapter_text import (
    SlcanReader,
    SocketcandReader,
    slcan_line,
    socketcand_element,
)
from drivers.codec.can_bus.canopen import CanFrame
from drivers.ports.writing import descriptor, write_some
from drivers.urls.can_bus import CanBusUrl

_PCAN_CLOCK = 80_000_000  # Hz
_SAMPLE_POINT = 80.0  # % of a bit
_SERIAL_TIMEOUT = 0.05  # s; of a read of the serial port
_CONNECT_TIMEOUT = 2.0  # s
_READ_MAX = 4096
_FULL = "Transmit buffer full"  # of python-can, if the socket's buffer is full
_HANDSHAKE = (("", b"< hi"), ("< open {channel} >", b"< ok"), ("< rawmode >", b"< ok"))
_IS_FRAME = re.compile(rb"\s*< (fd)?frame ")


def open_bus(url: CanBusUrl) -> can.BusABC:
    """Open the adapter to a bus; raises whatever its driver raises."""
    match url.interface:
        case "socketcand":
            return _Socketcand(url)
        case "slcan":
            return _Slcan(url)
        case "socketcan":
            # The bit rate is set with: ip link set can0 type can bitrate 500000.
            return can.Bus(
                interface="socketcan", channel=url.channel, fd=bool(url.fd), ignore_config=True
            )
        case _:
            channel = int(url.channel) if url.channel.isdecimal() else url.channel
            options: dict[str, Any] = {
                name: can.util.cast_from_string(text) for name, text in url.options
            }
            return can.Bus(
                interface=url.interface,
                channel=channel,
                ignore_config=True,
                bitrate=url.bitrate,
                receive_own_messages=False,
                **options,
                **(_fd_arguments(url) if url.fd else {}),
            )


def _fd_arguments(url: CanBusUrl) -> dict[str, Any]:
    """Arguments of python-can for CAN FD, as its interfaces call them."""
    match url.interface:
        case "nixnet":
            return {"fd": True, "fd_bitrate": url.fd}
        case "pcan":
            timing = can.BitTimingFd.from_sample_point(
                f_clock=_PCAN_CLOCK,
                nom_bitrate=url.bitrate,
                nom_sample_point=_SAMPLE_POINT,
                data_bitrate=url.fd,
                data_sample_point=_SAMPLE_POINT,
            )
            return {"timing": timing}
        case _:
            return {"fd": True, "data_bitrate": url.fd}


def send_some(bus: can.BusABC, frames: Sequence[CanFrame]) -> int:
    """Send frames without waiting until the adapter's transmit queue is full.

    Returns their number; raises can.CanError or OSError.
    """
    if isinstance(bus, _Socketcand | _Slcan):
        return bus.send_frames(frames)
    for number, frame in enumerate(frames):
        try:
            bus.send(_message(frame))
        except can.CanOperationError as error:
            if error.error_code == errno.ENOBUFS or _FULL in str(error):
                return number
            raise
    return len(frames)


def flush(bus: can.BusABC) -> bool:
    """Send what is left of a frame; returns whether nothing is left."""
    return bus.flush_unsent() if isinstance(bus, _Socketcand | _Slcan) else True


def wake(bus: can.BusABC) -> None:
    """Let a thread that waits in `recv` return or fail soon, if the adapter can."""
    if isinstance(bus, _Socketcand | _Slcan):
        bus.wake()
    elif isinstance(bus, VirtualBus):
        bus.queue.put(can.Message(is_error_frame=True))  # ignored


class _TextBus(can.BusABC):
    """A bus with frames as text."""

    def _reset(self) -> None:
        self._messages: deque[can.Message] = deque()
        self._unsent = b""

    def send_frames(self, frames: Sequence[CanFrame]) -> int:
        """Send all at once, or none while the adapter has not taken those before."""
        if not self.flush_unsent():
            return 0
        self._unsent = self._write_some(b"".join(map(self._text, frames)))
        return len(frames)

    def flush_unsent(self) -> bool:
        """Send what the adapter has not taken yet; returns whether nothing is left."""
        if self._unsent:
            self._unsent = self._write_some(self._unsent)
        return not self._unsent

    @abstractmethod
    def _text(self, frame: CanFrame) -> bytes:
        """Encode a frame."""

    @abstractmethod
    def _write_some(self, data: bytes) -> bytes:
        """Write what the adapter takes without waiting and return the rest."""

    def _received(self, frames: Iterable[CanFrame]) -> None:
        self._messages.extend(map(_message, frames))

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        if not self._messages:
            self._read_text(timeout)
        return (self._messages.popleft() if self._messages else None), False

    @abstractmethod
    def _read_text(self, timeout: float | None) -> None:
        """Wait for text for a time [s] and parse it."""


class _Socketcand(_TextBus):
    """A socketcand server."""

    def __init__(self, url: CanBusUrl) -> None:
        self._reset()
        self._reader = SocketcandReader()
        self.channel_info = f"socketcand on {url.channel}@{url.host}:{url.port}"
        self._connection = socket.create_connection((url.host, url.port), timeout=_CONNECT_TIMEOUT)
        try:
            self._connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._shake_hands(url.channel)
            self._connection.setblocking(False)  # reads wait for data first
            can.BusABC.__init__(self, channel=url.channel)
        except BaseException:
            self._connection.close()
            raise

    def _shake_hands(self, channel: str) -> None:
        """Open the bus in raw mode; frames may arrive from the first reply on."""
        text = b""
        for say, expected in _HANDSHAKE:
            self._connection.sendall(say.format(channel=channel).encode())
            element, text = self._element(text)
            while _IS_FRAME.match(element):
                element, text = self._element(text)
            if element.strip() != expected:
                raise can.CanInitializationError(f"reply must be {expected!r}, got {element!r}")
        self._received(self._reader.feed(text))

    def _element(self, text: bytes) -> tuple[bytes, bytes]:
        """Read the next element, without its end; returns it and the following text."""
        deadline = time.monotonic() + _CONNECT_TIMEOUT
        while b">" not in text:
            data = self._connection.recv(_READ_MAX)
            text += data
            if not data or len(text) > _READ_MAX or time.monotonic() > deadline:
                raise can.CanInitializationError(
                    f"reply must be of a socketcand server, got {text!r}"
                )
        element, _, rest = text.partition(b">")
        return element, rest

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Send one frame; see `send_frames`."""
        self.send_frames([CanFrame(msg.arbitration_id, bytes(msg.data), fd=msg.is_fd)])

    def shutdown(self) -> None:
        """Close the connection."""
        super().shutdown()
        self._connection.close()

    def wake(self) -> None:
        """Shut the connection down."""
        with contextlib.suppress(OSError):
            self._connection.shutdown(socket.SHUT_RDWR)

    def _text(self, frame: CanFrame) -> bytes:
        return socketcand_element(frame)

    def _write_some(self, data: bytes) -> bytes:
        try:
            return data[self._connection.send(data) :]
        except BlockingIOError:
            return data

    def _read_text(self, timeout: float | None) -> None:
        if select.select([self._connection], [], [], timeout)[0]:
            data = self._connection.recv(_READ_MAX)
            if not data:
                raise can.CanOperationError("connection closed by the socketcand server")
            self._received(self._reader.feed(data))


class _Slcan(_TextBus, slcanBus):
    """A serial adapter with exclusive use of its port, or one behind a TCP port."""

    def __init__(self, url: CanBusUrl) -> None:
        self._reset()
        self._reader = SlcanReader()
        self._is_ended = False
        self._is_remote = bool(url.host)
        slcanBus.__init__(
            self,
            url.channel or f"socket://{url.host}:{url.port}",
            tty_baudrate=url.baud,
            bitrate=None if url.fd else url.bitrate,
            sleep_after_open=0.0,
            timeout=_SERIAL_TIMEOUT,
        )
        try:
            self.serialPortOrig.write_timeout = 0  # where there is no descriptor
            if self._is_remote:
                _send_at_once(self.serialPortOrig.fileno())
            else:
                self.serialPortOrig.exclusive = True
            if url.fd:
                self.set_bitrate(url.bitrate, url.fd)
        except BaseException:
            self.shutdown()
            raise

    def wake(self) -> None:
        """Cancel reads, now and later."""
        self._is_ended = True
        with contextlib.suppress(OSError, AttributeError):
            self.serialPortOrig.cancel_read()

    def shutdown(self) -> None:
        """Close channel and port, also of a lost adapter."""
        connection = getattr(self.serialPortOrig, "_socket", None)
        with contextlib.suppress(can.CanError, OSError):
            slcanBus.shutdown(self)
        with contextlib.suppress(OSError):
            self.serialPortOrig.close()
        if connection is not None:  # pyserial leaves one open that the other side has closed
            connection.close()

    def _text(self, frame: CanFrame) -> bytes:
        return slcan_line(frame)

    def _write_some(self, data: bytes) -> bytes:
        opened = descriptor(self.serialPortOrig)
        if opened is not None:
            return write_some(opened, data)
        self.serialPortOrig.write(data)
        return b""

    def _read_text(self, timeout: float | None) -> None:
        port = self.serialPortOrig
        if self._is_remote:  # which pyserial would read byte by byte
            data = _received_now(port.fileno())
        else:
            data = port.read(max(1, port.in_waiting))
        self._received(self._reader.feed(data))
        if self._is_ended:
            raise can.CanOperationError("adapter is being closed")


def _send_at_once(connection: int) -> None:
    """Let a TCP connection send every frame without waiting for more."""
    with socket.fromfd(connection, socket.AF_INET, socket.SOCK_STREAM) as same:
        same.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)


def _received_now(connection: int) -> bytes:
    """Read what a connection has received, waiting shortly; CanOperationError if it is closed."""
    if not select.select([connection], [], [], _SERIAL_TIMEOUT)[0]:
        return b""
    data = os.read(connection, _READ_MAX)
    if not data:
        raise can.CanOperationError("connection closed by the adapter's server")
    return data


def _message(frame: CanFrame) -> can.Message:
    return can.Message(
        arbitration_id=frame.id,
        is_extended_id=False,
        is_fd=frame.fd,
        bitrate_switch=frame.fd,
        data=frame.data,
        timestamp=time.time(),
    )
