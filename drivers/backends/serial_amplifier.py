"""An amplifier on a serial line: a tty, a USB adapter, or a serial server on the network.

A thread of its own reads the port and posts what it reads into the event loop; everything else
happens there. A reply belongs to the request whose sequence number it carries.
"""

import asyncio
import contextlib
import errno
import secrets
import threading
import time
from dataclasses import dataclass

import serial

from drivers.backend import Backend
from drivers.backends.serial_url import SerialUrl
from drivers.errors import DriverError, LinkError, LinkTimeout
from drivers.protocol.messages import Reply, Request
from drivers.protocol.serial_codec import decode_reply, encode_request
from drivers.protocol.serial_frame import Frame, FrameReader, encode_frame
from drivers.protocol.serial_timing import exchange_time
from drivers.statistics import WireCounters

_READ_TIMEOUT = 0.1  # s; how long the reader of a port that cannot be woken notices its end
_WRITE_TIMEOUT = 0.02  # s; a frame fits into any driver's buffer unless the line is stuck


@dataclass
class _Pending:
    """A request on the wire and who waits for its reply."""

    request: Frame
    reply: asyncio.Future[Reply]


class SerialBackend(Backend):
    """Carries requests over a serial line given by its URL (see `SerialUrl`)."""

    def __init__(self, url: str) -> None:
        self._url = SerialUrl.parse(url)
        self._port: serial.Serial | None = None
        self._thread: threading.Thread | None = None
        self._closing = threading.Event()
        self._reader = FrameReader()
        self._pending: dict[int, _Pending] = {}
        # Not from zero, so that an answer to an earlier run is no answer to this one.
        self._sequence = secrets.randbelow(1 << 16)
        self._last_sent = 0.0
        self._loss: str | None = None
        self._counters = WireCounters()

    @property
    def counters(self) -> WireCounters:
        """What was seen on the line."""
        return self._counters

    @property
    def last_sent(self) -> float:
        """When the operating system took the last request's bytes, on time.monotonic() [s]."""
        return self._last_sent

    async def open(self) -> None:
        """Open the port, for this process alone where the system can; raises LinkError."""
        if self._port is not None:
            return
        try:
            self._port = await asyncio.to_thread(self._open_port)
        except (OSError, ValueError) as problem:
            raise LinkError(_why_not_open(self._url.port, problem)) from problem
        self._closing.clear()
        self._loss = None
        self._reader = FrameReader()
        self._thread = threading.Thread(
            target=self._read,
            args=(self._port, asyncio.get_running_loop()),
            name=f"era-serial {self._url.port}",
            daemon=True,
        )
        self._thread.start()

    async def close(self) -> None:
        """Close the port and end its reader; what still waits for a reply gets LinkError."""
        port, self._port = self._port, None
        thread, self._thread = self._thread, None
        self._closing.set()
        self._lose(f"{self._url.port} was closed")
        if port is None or thread is None:
            return
        if hasattr(port, "cancel_read"):
            with contextlib.suppress(OSError):
                port.cancel_read()
        await asyncio.to_thread(thread.join)
        await asyncio.to_thread(_close_port, port)

    async def exchange(self, request: Request, *, timeout: float) -> Reply:
        """Send a request and wait for its reply; LinkTimeout, LinkError or FrameError.

        timeout [s]: what the amplifier may take; the time on the line comes on top of it.
        """
        if self._port is None or self._loss is not None:
            raise LinkError(self._loss or f"{self._url.port} is not open")
        self._sequence = (self._sequence + 1) & 0xFFFF
        frame = encode_request(request, address=self._url.address, sequence=self._sequence)
        data = encode_frame(frame)
        try:
            async with asyncio.timeout(timeout + exchange_time(len(data), baud=self._url.baud)):
                self._write(self._port, data)
                return await self._reply_to(frame)
        except LinkError:
            raise
        except TimeoutError:
            raise LinkTimeout(
                f"no answer from address {self._url.address} on {self._url.port} within "
                f"{timeout * 1e3:g} ms; check that the amplifier is switched on and set to "
                f"{self._url.baud} baud"
            ) from None

    async def _reply_to(self, frame: Frame) -> Reply:
        pending = _Pending(frame, asyncio.get_running_loop().create_future())
        self._pending[frame.sequence] = pending
        try:
            return await pending.reply
        finally:
            del self._pending[frame.sequence]

    def _open_port(self) -> serial.Serial:
        port = serial.serial_for_url(
            self._url.port,
            do_not_open=True,
            baudrate=self._url.baud,
            timeout=_READ_TIMEOUT,
            write_timeout=_WRITE_TIMEOUT,
            exclusive=True,
        )
        port.open()
        port.reset_input_buffer()
        return port

    def _write(self, port: serial.Serial, data: bytes) -> None:
        try:
            port.write(data)
        except serial.SerialTimeoutException:
            raise LinkTimeout(
                f"{self._url.port} takes no more bytes; check flow control and the adapter"
            ) from None
        except OSError as problem:
            self._lose(self._what_was_lost(problem))
            raise LinkError(self._loss) from problem
        self._last_sent = time.monotonic()
        self._counters.frames_out += 1

    def _read(self, port: serial.Serial, loop: asyncio.AbstractEventLoop) -> None:
        """Read until the port is closed or lost; runs in the reader thread."""
        with contextlib.suppress(RuntimeError):  # of a loop that is closed: nobody waits any more
            try:
                while not self._closing.is_set():
                    data = port.read(1)
                    if data:
                        data += port.read(port.in_waiting)
                        loop.call_soon_threadsafe(self._received, data)
            except (OSError, TypeError) as problem:  # TypeError: closed while it was being read
                if not self._closing.is_set():
                    loop.call_soon_threadsafe(self._lose, self._what_was_lost(problem))

    def _received(self, data: bytes) -> None:
        frames = self._reader.feed(data)
        self._counters.frames_in += len(frames)
        self._counters.bad = self._reader.counters.bad
        for frame in frames:
            pending = self._pending.get(frame.sequence)
            if (
                pending is None
                or pending.reply.done()
                or not frame.is_reply
                or frame.address != self._url.address
            ):
                self._counters.foreign += 1
                continue
            try:
                pending.reply.set_result(decode_reply(frame, pending.request))
            except DriverError as problem:
                pending.reply.set_exception(problem)

    def _lose(self, what: str) -> None:
        if self._loss is None:
            self._loss = what
        for pending in self._pending.values():
            if not pending.reply.done():
                pending.reply.set_exception(LinkError(self._loss))

    def _what_was_lost(self, problem: Exception) -> str:
        return (
            f"serial line {self._url.port} was lost ({problem}): check the cable and the adapter, "
            "then open the amplifier again"
        )


def _close_port(port: serial.Serial) -> None:
    # pyserial does not close the socket of a server that hung up first, so that is done here.
    connection = getattr(port, "_socket", None)
    if connection is not None:
        connection.close()
    with contextlib.suppress(OSError):
        port.close()


def _why_not_open(port: str, problem: Exception) -> str:
    code = getattr(problem, "errno", None)
    if code is None and isinstance(problem.__context__, OSError):
        code = problem.__context__.errno
    if code == errno.ENOENT:
        remedy = "there is no such port; plug the adapter in and look at its name in /dev"
    elif code in (errno.EACCES, errno.EPERM):
        remedy = (
            "this user may not use it; add the user to the group that owns the port "
            "(often dialout: sudo usermod -aG dialout $USER) and log in again"
        )
    elif code in (errno.EAGAIN, errno.EBUSY):
        remedy = "another program has it open; close that one"
    elif code == errno.ECONNREFUSED or port.startswith("socket://"):
        remedy = "nobody answers there; check the address, and that the serial server runs"
    else:
        remedy = "check its name, that it is plugged in, and its speed"
    return f"serial port {port} cannot be opened: {remedy} (the system says: {problem})"
