"""One open serial port, shared by all amplifiers on it: frames out, and frames in to who waits.

Where the port has a file descriptor the event loop itself watches it, which is as fast as asking
the port in a loop; where it has none (RFC 2217, Windows) a thread reads and posts into the loop.
"""

import asyncio
import contextlib
import errno
import os
import threading
from collections.abc import Callable

import serial

from drivers import clock
from drivers.errors import LinkError, LinkTimeout
from drivers.protocol.serial_frame import Frame, FrameReader

_READ_TIMEOUT = 0.1  # s; how long the reader of a port that cannot be woken notices its end
_WRITE_TIMEOUT = 0.02  # s; a frame fits into any driver's buffer unless the line is stuck
_READ_MAX = 4096


class SerialLine:
    """A port as pyserial names it, at a speed [baud]; see `shared_line`.

    turn: held during an exchange, for no two amplifiers may answer at once on one pair of wires.
    """

    def __init__(self, port: str, *, baud: int) -> None:
        self.port = port
        self.turn = asyncio.Lock()
        self.last_sent = 0.0
        self.frames_out = 0
        self._baud = baud
        self._reader = FrameReader()
        self._users: dict[int, tuple[Callable[[Frame], None], Callable[[str], None]]] = {}
        self._loss: str | None = None
        self._serial: serial.Serial | None = None
        self._descriptor: int | None = None
        self._thread: threading.Thread | None = None
        self._closing = threading.Event()

    @property
    def baud(self) -> int:
        """Its speed."""
        return self._baud

    @property
    def bad(self) -> int:
        """How many damaged frames came in."""
        return self._reader.counters.bad

    @property
    def addresses(self) -> tuple[int, ...]:
        """Those in use."""
        return tuple(self._users)

    def raise_if_lost(self) -> None:
        """Raise LinkError where the port is gone."""
        if self._loss is not None:
            raise LinkError(self._loss)

    async def join(
        self, address: int, on_frame: Callable[[Frame], None], on_loss: Callable[[str], None]
    ) -> None:
        """Use the line for the amplifier at an address; the first to come opens the port.

        Raises LinkError: where the port cannot be opened, and for an address that is in use.
        """
        if address in self._users:
            raise LinkError(
                f"serial port {self.port}, address {address}: this program has it open already; "
                "give every amplifier an address of its own"
            )
        self._users[address] = (on_frame, on_loss)
        if len(self._users) > 1:
            return
        try:
            await self._open()
        except BaseException:
            self._users.clear()
            raise

    async def leave(self, address: int) -> None:
        """No longer use it; the last to go closes the port."""
        self._users.pop(address, None)
        if not self._users:
            await self._close()

    def send(self, data: bytes) -> None:
        """Put a frame on the line; raises LinkTimeout where it is stuck, LinkError."""
        self.raise_if_lost()
        port = self._serial
        if port is None:
            raise LinkError(f"{self.port} is not open")
        try:
            self._write(port, data)
        except serial.SerialTimeoutException:
            raise LinkTimeout(
                f"{self.port} takes no more bytes; check flow control and the adapter"
            ) from None
        except OSError as problem:
            self._lose(self._what_was_lost(problem))
            raise LinkError(self._loss) from problem
        self.last_sent = clock.now()
        self.frames_out += 1

    def _write(self, port: serial.Serial, data: bytes) -> None:
        if self._descriptor is not None:
            with contextlib.suppress(BlockingIOError):  # its buffer is full: wait a little
                data = data[os.write(self._descriptor, data) :]
            if not data:
                return
        port.write(data)

    async def _open(self) -> None:
        try:
            self._serial = await asyncio.to_thread(self._open_port)
        except (OSError, ValueError) as problem:
            raise LinkError(_why_not_open(self.port, problem)) from problem
        self._loss = None
        self._closing.clear()
        self._reader = FrameReader()
        loop = asyncio.get_running_loop()
        self._descriptor = _descriptor(self._serial)
        if self._descriptor is not None:
            loop.add_reader(self._descriptor, self._readable)
            return
        self._thread = threading.Thread(
            target=self._read,
            args=(self._serial, loop),
            name=f"era-serial {self.port}",
            daemon=True,
        )
        self._thread.start()

    async def _close(self) -> None:
        port, self._serial = self._serial, None
        thread, self._thread = self._thread, None
        self._ignore()
        self._closing.set()
        if port is None:
            return
        if thread is not None:
            if hasattr(port, "cancel_read"):
                with contextlib.suppress(OSError):
                    port.cancel_read()
            await asyncio.to_thread(thread.join)
        await asyncio.to_thread(_close_port, port)

    def _open_port(self) -> serial.Serial:
        port = serial.serial_for_url(
            self.port,
            do_not_open=True,
            baudrate=self._baud,
            timeout=_READ_TIMEOUT,
            # pyserial has none over RFC 2217
            write_timeout=None if self.port.startswith("rfc2217://") else _WRITE_TIMEOUT,
            exclusive=True,
        )
        port.open()
        # USB adapters hold bytes back for 16 ms unless they are told not to; most can be.
        with contextlib.suppress(OSError, ValueError, AttributeError, NotImplementedError):
            port.set_low_latency_mode(True)
        port.reset_input_buffer()
        return port

    def _readable(self) -> None:
        if self._descriptor is None:
            return
        try:
            data = os.read(self._descriptor, _READ_MAX)
        except BlockingIOError:
            return
        except OSError as problem:
            self._lose(self._what_was_lost(problem))
            return
        if data:
            self._received(data)
        else:
            self._lose(self._what_was_lost("it hung up"))

    def _ignore(self) -> None:
        descriptor, self._descriptor = self._descriptor, None
        if descriptor is not None:
            asyncio.get_running_loop().remove_reader(descriptor)

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
        for frame in self._reader.feed(data):
            # What is for nobody here is shown to one, who counts it as foreign.
            user = self._users.get(frame.address) or next(iter(self._users.values()), None)
            if user is not None:
                user[0](frame)

    def _lose(self, what: str) -> None:
        if self._loss is not None:
            return
        self._loss = what
        self._ignore()
        for _, on_loss in list(self._users.values()):
            on_loss(what)

    def _what_was_lost(self, problem: Exception | str) -> str:
        return (
            f"serial line {self.port} was lost ({problem}): check the cable and the adapter, "
            "then open the amplifier again"
        )


_LINES: dict[tuple[str, asyncio.AbstractEventLoop], SerialLine] = {}


def shared_line(port: str, *, baud: int) -> SerialLine:
    """The line of a port in the running event loop: the one in use, or a new one.

    Raises LinkError where it is in use at another speed.
    """
    key = (port, asyncio.get_running_loop())
    for known in [known for known, line in _LINES.items() if not line.addresses]:
        del _LINES[known]
    line = _LINES.setdefault(key, SerialLine(port, baud=baud))
    if line.baud != baud:
        raise LinkError(
            f"serial port {port} is open at {line.baud} baud and cannot have {baud} as well; "
            "give all amplifiers on it one speed"
        )
    return line


def _descriptor(port: serial.Serial) -> int | None:
    if os.name != "posix":
        return None
    try:
        return int(port.fileno())
    except (OSError, AttributeError):  # UnsupportedOperation is one of OSError
        return None


def _close_port(port: serial.Serial) -> None:
    # pyserial does not close the socket of a server that hung up first, so that is done here.
    connection = getattr(port, "_socket", None)
    if connection is not None and str(port.port).startswith("socket://"):
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
    elif code == errno.ECONNREFUSED or port.startswith(("socket://", "rfc2217://")):
        remedy = "nobody answers there; check the address, and that the serial server runs"
    elif port.startswith("hwgrep://"):
        remedy = "no port fits the pattern; list them: python -m serial.tools.list_ports -v"
    else:
        remedy = "check its name, that it is plugged in, and its speed"
    return f"serial port {port} cannot be opened: {remedy} (the system says: {problem})"
