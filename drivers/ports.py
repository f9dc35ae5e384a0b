"""Ports: serial devices of this machine and TCP connections that carry the bytes of a line.

The event loop reads each device that it can watch; a thread reads any other, and threads make all
calls that may block. A serial port never blocks the loop: bytes that it does not take immediately
are sent as soon as it does, unless a newer frame replaces them, because late bytes must not delay a
stop. `PORT_OPENER` replaces serial ports, for example by a simulation in virtual time.
"""

import asyncio
import contextlib
import errno
import ipaddress
import os
import select
import socket
import threading
from abc import ABC, abstractmethod
from asyncio.staggered import staggered_race
from collections.abc import Awaitable, Callable
from contextvars import ContextVar
from functools import partial
from typing import ClassVar, Protocol, TypeAlias, cast, final

import serial

from drivers.errors import LinkError, LinkTimeout, system_message
from drivers.urls import Endpoint
from registry.threads import close_in_thread, in_thread


class OpenPort(Protocol):
    """Interface of an open port to its line; the port reports data and its loss."""

    @property
    def is_blocked(self) -> bool:
        """Whether the device has not taken all bytes yet."""

    def write(self, data: bytes) -> None:
        """Send bytes as soon as the device takes them, without waiting.

        They replace bytes not sent yet. Raises LinkError if the port is lost, LinkTimeout if it
        stays blocked.
        """

    def poll(self) -> None:
        """Deliver bytes that have arrived and were not read yet."""


class Port(OpenPort, Protocol):
    """A port of a line; data and loss are reported to the callbacks of its opening."""

    def close(self) -> None:
        """Close it; no callback is called afterwards."""

    async def wait_closed(self) -> None:
        """Wait until it is closed."""


PortOpener: TypeAlias = Callable[
    [str, Callable[[bytes], None], Callable[[str], None]], Awaitable[Port]
]
"""A function that opens a serial port by name, with callbacks for data and loss.

Raises LinkError.
"""

PORT_OPENER: ContextVar[PortOpener | None] = ContextVar("PORT_OPENER", default=None)
"""Opener of serial ports in this context; None: the machine's ports."""

FAILURES: tuple[type[Exception], ...] = (OSError, ValueError, TypeError)
"""Errors of a lost device; pyserial raises TypeError if closed during a read."""


class DevicePort(ABC):
    """A device, which may hang; implements `Port`.

    name: name of the device. descriptor: watched by the event loop; None if a thread must read the
    device, because reading may block. on_data: called with received bytes. on_loss: called once
    with the cause of a loss. shut: closes the device, even if it is lost.
    """

    kind: ClassVar[str]
    """Kind of the device, as messages name it."""
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
        self._threads: list[threading.Thread] = []
        if descriptor is not None:
            self.loop.add_reader(descriptor, self.poll)
        else:
            self.start_thread(self._read, name=f"era-read {name}")

    def start_thread(self, work: Callable[[], None], *, name: str) -> None:
        """Start a thread for calls that may block; it ends once `closing` is set.

        An exception in it is a loss of the device.
        """
        thread = threading.Thread(target=self._run, args=(work,), name=name, daemon=True)
        self._threads.append(thread)
        thread.start()

    @abstractmethod
    def read_watched(self) -> bytes:
        """Return the bytes that have arrived; raises one of `failures`."""

    def read_waiting(self) -> bytes:
        """Return the bytes that arrive within a short time; raises one of `failures`.

        The thread of a device without a descriptor calls it.
        """
        raise NotImplementedError

    def poll(self) -> None:
        """Deliver bytes that have arrived; a reader thread delivers them by itself."""
        if self.descriptor is None:
            return
        try:
            data = self.read_watched()
        except self.failures as error:
            self.lose(error)
            return
        self.received(data)  # outside of `try`: what fails there is no loss of the port

    def received(self, data: bytes) -> None:
        """Deliver received bytes."""
        if data and not self.closing.is_set():
            self._on_data(data)

    def lose(self, problem: Exception) -> LinkError:
        """Close the port and report its loss once; returns the error for the current request."""
        loss = (
            f"{self.kind} {self.name} was lost ({problem}): check the cable and the adapter, then "
            "open the amplifier again"
        )
        if not self.closing.is_set():
            self.close()
            self._on_loss(loss)
        return LinkError(loss)

    def close(self) -> None:
        """Stop reading and writing; `wait_closed` then waits until the device is closed."""
        self.closing.set()
        watched, self.descriptor = self.descriptor, None
        if watched is not None:
            self.loop.remove_reader(watched)

    async def wait_closed(self) -> None:
        """Wait until the device is closed, but only briefly if it hangs."""
        # For a device that takes no more bytes, the system would wait half a minute.
        await close_in_thread(self._close_device, name=f"era-close {self.name}")

    def _close_device(self) -> None:
        for thread in self._threads:
            thread.join()
        with contextlib.suppress(*self.failures):
            self._shut()

    def _run(self, work: Callable[[], None]) -> None:
        """Do the work of a thread, and report its failure as a loss."""
        with contextlib.suppress(RuntimeError):  # a closed loop raises it
            try:
                work()
            except Exception as error:  # after any failure the device is of no use
                self.loop.call_soon_threadsafe(self.lose, error)

    def _read(self) -> None:
        """Read until the port is closed or lost; this is the reader thread."""
        while not self.closing.is_set():
            data = self.read_waiting()
            if data:
                self.loop.call_soon_threadsafe(self.received, data)


NETWORK_DELAY = 1.0
"""Time [s] after which a port closes a connection that does not accept sent data.

Later delivery by a broken network is not considered.
"""
CONNECT_TIMEOUT = 1.0  # s; a hundred times the delay within a building
_NEXT_AFTER = 0.25  # s; RFC 8305, section 5; after a refusal, the next address follows immediately
_NUMERIC = socket.NI_NUMERICHOST | socket.NI_NUMERICSERV
_READ_MAX = 4096  # bytes per read, so that other connections get their turn
_UNSENT_MAX = 4096  # bytes; sixteen unsent frames mean a blocked connection


async def open_connection(
    host: str, port: int, on_data: Callable[[bytes], None], on_loss: Callable[[str], None]
) -> Port:
    """Connect to the first address of a host that accepts; raises LinkError with a remedy."""
    endpoint = f"{host}:{port}"
    try:
        async with asyncio.timeout(CONNECT_TIMEOUT):
            return await _first_to_accept(host, port, _Connection(endpoint, on_data, on_loss))
    except TimeoutError:
        raise LinkError(
            f"{endpoint}: no connection within {CONNECT_TIMEOUT:g} s; check the address, the "
            "network and that the amplifier is switched on"
        ) from None
    except OSError as error:
        raise LinkError(
            f"{endpoint}: connection refused; check the address and the port, and that the "
            f"amplifier is switched on (system error: {system_message(error)})"
        ) from error


class _Connection(asyncio.BufferedProtocol):
    """A TCP connection."""

    def __init__(
        self, endpoint: str, on_data: Callable[[bytes], None], on_loss: Callable[[str], None]
    ) -> None:
        self._endpoint = endpoint
        self._on_data = on_data
        self._buffer = bytearray(_READ_MAX)
        self._on_loss = on_loss
        self._is_closed = self.is_made = False
        self._transport: asyncio.Transport  # set when connected

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Configure the connection to send small frames immediately, and to fail if it is broken.

        Otherwise a frame could wait 40 ms for the acknowledgement of the previous one, and a broken
        network could deliver frames minutes later.
        """
        self._transport, self.is_made = cast(asyncio.Transport, transport), True
        connection = transport.get_extra_info("socket")
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        if hasattr(socket, "TCP_USER_TIMEOUT"):  # Linux
            timeout = round(1000 * NETWORK_DELAY)
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, timeout)

    def get_buffer(self, sizehint: int) -> bytearray:
        return self._buffer

    def buffer_updated(self, nbytes: int) -> None:
        if not self._is_closed:
            self._on_data(bytes(self._buffer[:nbytes]))

    def connection_lost(self, exc: Exception | None) -> None:
        if not self._is_closed:
            self._is_closed = True
            why = str(exc) if exc else "closed by the other side"
            self._on_loss(
                f"the connection to {self._endpoint} was lost ({why}): check the amplifier and the "
                "network, then open the amplifier again"
            )

    @property
    def is_blocked(self) -> bool:
        return self._transport.get_write_buffer_size() > 0

    def poll(self) -> None:
        """Do nothing: the loop reads before it runs timers that are due later."""

    def write(self, data: bytes) -> None:
        if self._transport.get_write_buffer_size() > _UNSENT_MAX:
            raise LinkTimeout(f"{self._endpoint}: write blocked; check the network")
        self._transport.write(data)

    def close(self) -> None:
        self._is_closed = True
        self._transport.abort()  # discards unsent bytes

    async def wait_closed(self) -> None:
        """Return immediately, because `abort` does not block."""


async def _first_to_accept(host: str, port: int, connection: _Connection) -> Port:
    """Connect to the first address of a host that accepts (RFC 8305); raises OSError."""
    connect = asyncio.get_running_loop().create_connection
    take = [connection].pop  # the first accepting address gets it, the others an IndexError
    attempts = [partial(connect, take, each, port) for each in await host_addresses(host)]
    try:
        _, index, failures = await staggered_race(attempts, _NEXT_AFTER)
    except BaseException:
        if connection.is_made:  # this was cancelled just after an address had accepted
            connection.close()
        raise
    if index is None and failures[-1] is not None:
        raise failures[-1]
    return connection


async def host_addresses(host: str) -> list[str]:
    """Resolve a host name to at least one address; raises OSError."""
    try:
        return [str(ipaddress.ip_address(host))]
    except ValueError:
        # asyncio would resolve it in a thread that delays the end of the program.
        found = await in_thread(
            lambda: socket.getaddrinfo(host, None, type=socket.SOCK_STREAM), name=f"era-name {host}"
        )
        # The result includes the zone of a link-local address.
        return [socket.getnameinfo(each, _NUMERIC)[0] for *_, each in found]


_NO_PERMISSION = (
    "no permission; add the user to the group that owns the port "
    "(often dialout: sudo usermod -aG dialout $USER) and log in again"
)
_UNKNOWN = "check its name, the plug, its speed and its parity"
_IN_USE = "in use by another program; close that one"
_REMEDIES = {
    errno.ENOENT: "no such port; plug in the adapter and check its name in /dev",
    errno.EACCES: _NO_PERMISSION,
    errno.EPERM: _NO_PERMISSION,
    errno.EAGAIN: _IN_USE,
    errno.EBUSY: _IN_USE,
}


async def open_port(
    place: Endpoint, on_data: Callable[[bytes], None], on_loss: Callable[[str], None]
) -> Port:
    """Open a device, exclusively if the system can, or connect to a server; raises LinkError.

    on_data: is called with received bytes; on_loss: is called once with the cause of a loss.
    """
    if place.host:
        return await open_connection(place.host, place.port, on_data, on_loss)
    name = place.device
    opener = PORT_OPENER.get()
    if opener is not None:
        return await opener(name, on_data, on_loss)
    import termios  # not on Windows

    try:
        port = await in_thread(
            lambda: open_device(place), name=f"era-open {name}", undo=lambda port: port.close()
        )
    except (OSError, ValueError, termios.error) as error:  # of pyserial
        raise LinkError(
            f"serial port {name} cannot be opened: {remedy_of(error)} (system error: "
            f"{system_message(error)})"
        ) from error
    return SerialPort(port, name, on_data, on_loss)


def open_device(place: Endpoint) -> serial.Serial:
    """Open a serial port or pseudo-terminal exclusively; raises errors of pyserial."""
    import termios

    # A pseudo-terminal has no parity and may reject all settings if parity is given.
    is_pseudo = os.path.realpath(place.device).startswith("/dev/pts/")
    port = serial.Serial(
        place.device,
        baudrate=place.baud,
        parity=serial.PARITY_NONE if is_pseudo else place.parity,
        stopbits=place.stop,
        exclusive=True,
    )
    try:
        # USB adapters delay bytes by 16 ms unless low latency is set, which most support.
        with contextlib.suppress(OSError, ValueError, AttributeError, NotImplementedError):
            port.set_low_latency_mode(True)
        # DTR stays set when the port is closed, so that a board reset by DTR restarts only when
        # the port is first opened.
        settings = termios.tcgetattr(port.fileno())
        settings[2] &= ~termios.HUPCL
        termios.tcsetattr(port.fileno(), termios.TCSANOW, settings)
        port.reset_input_buffer()
    except BaseException:
        port.close()  # otherwise this program would keep it and could not open it again
        raise
    return port


def remedy_of(error: BaseException | None) -> str:
    """Return the remedy for an error of opening, based on its error code or its cause's."""
    while error is not None:
        code = getattr(error, "errno", None)
        if code is not None:
            return _REMEDIES.get(code, _UNKNOWN)
        error = error.__cause__ or error.__context__
    return _UNKNOWN


@final
class SerialPort(DevicePort):
    """A port of pyserial, read and written by the event loop."""

    kind = "serial line"

    def __init__(
        self,
        port: serial.Serial,
        name: str,
        on_data: Callable[[bytes], None],
        on_loss: Callable[[str], None],
    ) -> None:
        self._unsent = b""
        super().__init__(name, port.fileno(), on_data, on_loss, port.close)

    @property
    def is_blocked(self) -> bool:
        """Whether the port has not taken all bytes yet."""
        return bool(self._unsent)

    def write(self, data: bytes) -> None:
        """Send bytes, as soon as the port takes them; raises LinkError."""
        self._unsent = data
        self._send()
        if self._unsent and self.descriptor is not None:
            self.loop.add_writer(self.descriptor, self._send_rest)

    def close(self) -> None:
        """Stop reading and writing; `wait_closed` closes the port."""
        self._unsent = b""
        if self.descriptor is not None:
            self.loop.remove_writer(self.descriptor)
        super().close()

    def read_watched(self) -> bytes:
        """Return received bytes; OSError at the end, which an empty read of a terminal is not."""
        if self.descriptor is None:
            return b""
        try:
            data = os.read(self.descriptor, _READ_MAX)
        except BlockingIOError:
            return b""
        if not data:
            state = select.poll()
            state.register(self.descriptor, 0)  # a hang-up is still reported
            if state.poll(0):
                raise OSError("end of file")
        return data

    def _send(self) -> None:
        """Write as much as the descriptor accepts; raises LinkError."""
        if self.descriptor is None:
            raise self.lose(OSError("it is closed"))
        try:
            self._unsent = self._unsent[os.write(self.descriptor, self._unsent) :]
        except BlockingIOError:
            return
        except OSError as error:
            raise self.lose(error) from error

    def _send_rest(self) -> None:
        """Send the rest once there is room; a newer frame may have replaced it."""
        with contextlib.suppress(LinkError):  # reported as a loss
            self._send()
        if not self._unsent and self.descriptor is not None:
            self.loop.remove_writer(self.descriptor)
