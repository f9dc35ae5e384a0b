"""Adapters to CAN as python-can knows them, made fit for a bus that may go away or talk nonsense.

python-can's socketcand never notices that its server has hung up, and both it and slcan stumble
for ever over text that makes no frame. Here both are read anew: what makes no frame is skipped.
"""

import contextlib
import re
import select
import socket
import time
from collections import deque
from collections.abc import Sequence
from typing import Any, cast

import can
from can.interfaces.slcan import slcanBus
from can.interfaces.socketcand.socketcand import SocketCanDaemonBus

from drivers.backends.can_url import CanBusUrl

SEND_TIMEOUT = 0.02  # s; a frame fits into any driver's buffer unless the bus is stuck
_SERIAL_TIMEOUT = 0.05  # s; how long a read of the serial port waits
_CONNECT_TIMEOUT = 2.0  # s
_LONGEST = 512  # characters without the end of a frame
_FD_LENGTHS = (0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64)
_ELEMENT = re.compile(
    r"< (frame|fdframe) ([0-9A-Fa-f]{3}|[0-9A-Fa-f]{8}) (?:[0-9A-Fa-f]{2} )?[0-9.]+ "
    r"((?:[0-9A-Fa-f]{2} ?)*) ?>"
)
_LINE = re.compile(r"([tdb])([0-9A-Fa-f]{3})([0-9A-Fa-f])((?:[0-9A-Fa-f]{2})*)(?:[0-9A-F]{4})?")
_BUSY_HANDSHAKE = 3  # tries; a frame right after the greeting looks like a wrong one


def open_bus(url: CanBusUrl) -> can.BusABC:
    """The adapter to a bus, open; raises can.CanError, OSError or ValueError."""
    match url.interface:
        case "socketcand":
            return _open_socketcand(url)
        case "slcan":
            return _Slcan(url)
        case "socketcan":
            # The bit rate is the interface's own: ip link set can0 type can bitrate 500000.
            return can.Bus(
                interface="socketcan", channel=url.channel, fd=bool(url.fd), ignore_config=True
            )
        case _:
            return can.Bus(interface=url.interface, channel=url.channel, ignore_config=True)


def send_all(bus: can.BusABC, messages: Sequence[can.Message]) -> None:
    """Send messages one after the other; raises can.CanError or OSError."""
    if isinstance(bus, _Slcan | _Socketcand):
        bus.send_text("".join(map(bus.text_of, messages)))
        return
    for message in messages:
        bus.send(message, timeout=SEND_TIMEOUT)


def wake(bus: can.BusABC) -> None:
    """Let a thread that waits in `recv` return soon, where the adapter can."""
    if isinstance(bus, _Slcan | _Socketcand):
        bus.wake()


class _Socketcand(SocketCanDaemonBus):
    """A server of the socketcand daemon, with frames read by whole elements."""

    def __init__(self, url: CanBusUrl) -> None:
        self._text = ""
        self._messages: deque[can.Message] = deque()
        super().__init__(  # type: ignore[no-untyped-call]
            url.channel, url.host, url.port, tcp_tune=True
        )
        # Nobody reads without waiting for a byte first, so this only limits how long sending takes.
        self._connection.settimeout(SEND_TIMEOUT)

    @property
    def _connection(self) -> socket.socket:
        return cast(socket.socket, self._SocketCanDaemonBus__socket)  # type: ignore[attr-defined]

    def wake(self) -> None:
        """End the connection."""
        with contextlib.suppress(OSError):
            self._connection.shutdown(socket.SHUT_RDWR)

    def text_of(self, message: can.Message) -> str:
        """The element that sends a message; CAN FD needs a daemon that knows it."""
        data = message.data.hex(" ")
        if message.is_fd:
            return f"< fdsend {message.arbitration_id:03X} 00 {message.dlc} {data} >"
        return f"< send {message.arbitration_id:03X} {message.dlc:X} {data} >"

    def send_text(self, text: str) -> None:
        """Send elements."""
        self._connection.sendall(text.encode("ascii"))

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        if not self._messages and self._is_readable(timeout):
            data = self._connection.recv(4096)
            if not data:
                raise can.CanOperationError("the socketcand server hung up")
            self._read(data.decode("ascii", errors="replace"))
        return (self._messages.popleft() if self._messages else None), False

    def _is_readable(self, timeout: float | None) -> bool:
        return bool(select.select([self._connection], [], [], timeout)[0])

    def _read(self, text: str) -> None:
        *elements, rest = (self._text + text).split(">")
        self._text = rest if len(rest) <= _LONGEST else ""
        for element in elements:
            found = _ELEMENT.fullmatch(element[max(element.rfind("<"), 0) :] + ">")
            if found:
                kind, identifier, data = found.groups()
                message = _message(identifier, bytes.fromhex(data), is_fd=kind == "fdframe")
                if message is not None:
                    self._messages.append(message)


class _Slcan(slcanBus):
    """A serial adapter, its port for this process alone, read by whole lines."""

    def __init__(self, url: CanBusUrl) -> None:
        self._text = b""
        self._lines: deque[str] = deque()
        super().__init__(
            url.channel,
            tty_baudrate=url.baud,
            bitrate=None if url.fd else url.bitrate,
            sleep_after_open=0.0,
            timeout=_SERIAL_TIMEOUT,
        )
        self.serialPortOrig.write_timeout = SEND_TIMEOUT
        try:
            self.serialPortOrig.exclusive = True
            if url.fd:
                self.set_bitrate(url.bitrate, url.fd)
        except BaseException:
            self.shutdown()
            raise

    def wake(self) -> None:
        """End a read that waits."""
        with contextlib.suppress(OSError, AttributeError):
            self.serialPortOrig.cancel_read()

    def shutdown(self) -> None:
        """Close channel and port, also where the adapter is gone."""
        with contextlib.suppress(can.CanError, OSError):
            super().shutdown()
        with contextlib.suppress(OSError):
            self.serialPortOrig.close()

    def text_of(self, message: can.Message) -> str:
        """The command that sends a message."""
        kind = "b" if message.is_fd else "t"
        length = _FD_LENGTHS.index(message.dlc)
        return f"{kind}{message.arbitration_id:03X}{length:X}{message.data.hex().upper()}\r"

    def send_text(self, text: str) -> None:
        """Send commands, without python-can's wait until the last byte is out."""
        self.serialPortOrig.write(text.encode("ascii"))

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        if not self._lines:
            self._read_lines()
        while self._lines:
            found = _LINE.fullmatch(self._lines.popleft())
            if found:
                kind, identifier, length, data = found.groups()
                if 2 * _FD_LENGTHS[int(length, 16)] == len(data):
                    content = bytes.fromhex(data)
                    message = _message(identifier, content, is_fd=kind != "t")
                    if message is not None:
                        return message, False
        return None, False

    def _read_lines(self) -> None:
        port = self.serialPortOrig
        data = port.read(max(1, port.in_waiting))
        *lines, rest = re.split(rb"[\r\x07]", self._text + data)
        self._text = rest if len(rest) <= _LONGEST else b""
        self._lines.extend(line.decode("ascii", errors="replace") for line in lines)


def _message(identifier: str, data: bytes, *, is_fd: bool) -> can.Message | None:
    """The frame with this identifier in hexadecimal, or None where there is no such frame."""
    number = int(identifier, 16)
    is_extended = len(identifier) > 3
    if number > (0x1FFF_FFFF if is_extended else 0x7FF):
        return None
    if len(data) > 8 and not (is_fd and len(data) in _FD_LENGTHS):
        return None
    return can.Message(
        arbitration_id=number,
        is_extended_id=is_extended,
        is_fd=is_fd,
        data=data,
        timestamp=time.time(),
    )


def _open_socketcand(url: CanBusUrl) -> _Socketcand:
    # python-can would try for ten seconds, and wait for a greeting for ever.
    with socket.create_connection((url.host, url.port), timeout=_CONNECT_TIMEOUT) as probe:
        greeting = probe.recv(64)
    if not greeting.startswith(b"< hi >"):
        raise can.CanInitializationError(f"it greets with {greeting!r}: no socketcand server")
    problem: Any = None
    for _ in range(_BUSY_HANDSHAKE):
        try:
            return _Socketcand(url)
        except can.CanError as error:
            problem = error
    raise problem
