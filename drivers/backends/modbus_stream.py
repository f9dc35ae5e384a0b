"""The bytes of a Modbus line, both ways: a TCP connection or a serial port.

A serial port is read by the event loop itself; loops that cannot (those of Windows) have TCP only.
"""

import asyncio
import contextlib
import errno
import os
from collections.abc import Callable
from typing import Protocol, cast

import serial

from drivers.backends.modbus_url import ModbusUrl
from drivers.backends.serial_write import write_all
from drivers.backends.stand_in import STAND_IN
from drivers.errors import LinkError, LinkTimeout

_CONNECT_TIMEOUT = 1.0  # s; an amplifier in the same building answers a hundred times faster
_WRITE_TIMEOUT = 0.02  # s; a frame fits into any driver's buffer unless the line is stuck
_UNSENT_MAX = 4096  # bytes; sixteen frames that a peer does not take are no slow network any more
_READ_MAX = 4096
_FAILURES: tuple[type[Exception], ...] = (OSError, ValueError)  # of pyserial, at opening
with contextlib.suppress(ImportError):  # Windows has no terminals
    import termios

    _FAILURES += (termios.error,)


class Stream(Protocol):
    """An open line. What it reads, and once why it was lost, goes to who opened it."""

    def write(self, data: bytes) -> None:
        """Send bytes; LinkTimeout where the line takes no more, LinkError where it is gone."""

    def close(self) -> None:
        """Close it; nothing is told any more."""


async def open_stream(
    line: ModbusUrl, on_data: Callable[[bytes], None], on_loss: Callable[[str], None]
) -> Stream:
    """Open a line; LinkError says what to do about one that cannot be opened."""
    if line.device:
        return await _open_serial(line, on_data, on_loss)
    return await _connect(line, on_data, on_loss)


class _Connection(asyncio.Protocol):
    """A TCP connection."""

    def __init__(
        self, place: str, on_data: Callable[[bytes], None], on_loss: Callable[[str], None]
    ) -> None:
        self._place = place
        self._on_data = on_data
        self._on_loss = on_loss
        self._is_closed = False
        self._transport: asyncio.Transport | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast(asyncio.Transport, transport)

    def data_received(self, data: bytes) -> None:
        if not self._is_closed:
            self._on_data(data)

    def connection_lost(self, exc: Exception | None) -> None:
        if not self._is_closed:
            self._is_closed = True
            why = str(exc) if exc else "the other side hung up"
            self._on_loss(
                f"the Modbus connection to {self._place} was lost ({why}): check the amplifier and "
                "the network, then open the amplifier again"
            )

    def write(self, data: bytes) -> None:
        if self._transport is None or self._is_closed:
            raise LinkError(f"the Modbus connection to {self._place} is closed")
        if self._transport.get_write_buffer_size() > _UNSENT_MAX:
            raise LinkTimeout(f"{self._place} takes no more bytes; check the network")
        self._transport.write(data)

    def close(self) -> None:
        self._is_closed = True
        if self._transport is not None:
            self._transport.abort()  # nothing that waits to be sent shall arrive later


async def _connect(
    line: ModbusUrl, on_data: Callable[[bytes], None], on_loss: Callable[[str], None]
) -> Stream:
    loop = asyncio.get_running_loop()
    try:
        async with asyncio.timeout(_CONNECT_TIMEOUT):
            _, connection = await loop.create_connection(
                lambda: _Connection(line.place, on_data, on_loss), line.host, line.port
            )
    except TimeoutError:
        raise LinkError(
            f"{line.place} does not answer within {_CONNECT_TIMEOUT:g} s; check the address, the "
            "network and that the amplifier is switched on"
        ) from None
    except OSError as problem:
        raise LinkError(
            f"{line.place} takes no Modbus connection: check the address and the port, and that "
            f"the amplifier is switched on (the system says: {problem})"
        ) from problem
    return connection


class _SerialPort:
    """A serial port that the event loop reads."""

    def __init__(
        self,
        port: serial.Serial,
        name: str,
        on_data: Callable[[bytes], None],
        on_loss: Callable[[str], None],
    ) -> None:
        self._port = port
        self._name = name
        self._on_data = on_data
        self._on_loss = on_loss
        self._loop = asyncio.get_running_loop()
        self._descriptor: int | None = port.fileno()
        self._loop.add_reader(port.fileno(), self._readable)

    def write(self, data: bytes) -> None:
        if self._descriptor is None:
            raise LinkError(f"serial port {self._name} is closed")
        try:
            write_all(self._port, data)
        except serial.SerialTimeoutException:
            raise LinkTimeout(
                f"{self._name} takes no more bytes; check flow control and the adapter"
            ) from None
        except OSError as problem:
            raise LinkError(self._lost(str(problem))) from problem

    def close(self) -> None:
        if self._descriptor is None:
            return
        self._loop.remove_reader(self._descriptor)
        self._descriptor = None
        with contextlib.suppress(OSError):
            self._port.close()

    def _readable(self) -> None:
        if self._descriptor is None:
            return
        try:
            data = os.read(self._descriptor, _READ_MAX)
        except BlockingIOError:
            return
        except OSError as problem:
            self._lost(str(problem))
            return
        if data:
            self._on_data(data)
        else:
            self._lost("the adapter is gone")

    def _lost(self, why: str) -> str:
        what = (
            f"serial line {self._name} was lost ({why}): check the cable and the adapter, then "
            "open the amplifier again"
        )
        self.close()
        self._on_loss(what)
        return what


async def _open_serial(
    line: ModbusUrl, on_data: Callable[[bytes], None], on_loss: Callable[[str], None]
) -> Stream:
    stand_in = STAND_IN.get()
    if stand_in is not None:
        return await stand_in.open_port(line.device, on_data=on_data, on_loss=on_loss)
    try:
        port = await asyncio.to_thread(_open_port, line)
    except _FAILURES as problem:
        raise LinkError(_why_not_open(line.device, problem)) from problem
    try:
        return _SerialPort(port, line.device, on_data, on_loss)
    except (NotImplementedError, OSError) as problem:
        port.close()
        raise LinkError(
            f"this system cannot wait for serial port {line.device}; reach the amplifier by "
            "modbus+tcp:// or through a serial server, modbus+rtu://HOST:PORT#UNIT"
        ) from problem


def _open_port(line: ModbusUrl) -> serial.Serial:
    # A pseudo-terminal has no parity, and where it is asked for one it may refuse everything.
    is_pseudo = os.path.realpath(line.device).startswith("/dev/pts/")
    port = serial.Serial(
        line.device,
        baudrate=line.baud,
        parity=serial.PARITY_NONE if is_pseudo else line.parity,
        stopbits=line.stop,
        timeout=0,
        write_timeout=_WRITE_TIMEOUT,
        exclusive=True,
    )
    port.reset_input_buffer()
    return port


def _why_not_open(device: str, problem: Exception) -> str:
    code = getattr(problem, "errno", None)
    if code == errno.ENOENT:
        remedy = "there is no such port; plug the adapter in and look at its name in /dev"
    elif code in (errno.EACCES, errno.EPERM):
        remedy = (
            "this user may not use it; add the user to the group that owns the port "
            "(often dialout: sudo usermod -aG dialout $USER) and log in again"
        )
    elif code in (errno.EAGAIN, errno.EBUSY):
        remedy = "another program has it open; close that one"
    else:
        remedy = "check its name, that it is plugged in, its speed and its parity"
    return f"serial port {device} cannot be opened: {remedy} (the system says: {problem})"
