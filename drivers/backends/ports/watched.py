"""An open serial port, read by the event loop or by a thread; for every wire that is one.

Where the port has a file descriptor the event loop itself watches it, which is as fast as asking
the port in a loop; where it has none (RFC 2217, Windows) a thread reads and posts into the loop.
"""

import asyncio
import contextlib
import errno
import os
import socket
import threading
from collections.abc import Callable
from typing import final

import serial

from drivers.backends.ports.writing import descriptor, write_all
from drivers.errors import LinkError, LinkTimeout
from drivers.threads import close_in_thread

READ_TIMEOUT = 0.1  # s; how long the reader of a port that cannot be woken notices its end
WRITE_TIMEOUT = 0.02  # s; a frame fits into any driver's buffer unless the line is stuck
_READ_MAX = 4096


@final
class WatchedPort:
    """A port of pyserial's, opened with these time-outs; `Port` is what it does.

    on_data is called with what comes in, on_loss once with why the port was lost.
    """

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
        self._is_lost = False
        self._closing = threading.Event()
        self._thread: threading.Thread | None = None
        self._descriptor = descriptor(port)
        if self._descriptor is not None:
            self._loop.add_reader(self._descriptor, self._readable)
            return
        self._thread = threading.Thread(target=self._read, name=f"era-serial {name}", daemon=True)
        self._thread.start()

    def write(self, data: bytes) -> None:
        """Send bytes; raises LinkTimeout where the line is stuck, LinkError."""
        try:
            write_all(self._port, data)
        except serial.SerialTimeoutException:
            raise LinkTimeout(
                f"{self._name} takes no more bytes; check flow control and the adapter"
            ) from None
        except OSError as problem:
            what = self._what_was_lost(problem)
            self._lose(what)
            raise LinkError(what) from problem

    def close(self) -> None:
        """Read no more; `wait_closed` gives the port back."""
        self._ignore()
        self._closing.set()
        if self._thread is not None and hasattr(self._port, "cancel_read"):
            with contextlib.suppress(OSError):
                self._port.cancel_read()

    async def wait_closed(self) -> None:
        """Wait until the reader has ended and the port is closed; not for a device that hangs."""
        # Where the device takes nothing any more, the system waits half a minute for it.
        await close_in_thread(self._give_back, name=f"era-close {self._name}")

    def _give_back(self) -> None:
        if self._thread is not None:
            self._thread.join()
        close_port(self._port)

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
            self._on_data(data)
        else:
            self._lose(self._what_was_lost("it hung up"))

    def _ignore(self) -> None:
        watched, self._descriptor = self._descriptor, None
        if watched is not None:
            self._loop.remove_reader(watched)

    def _read(self) -> None:
        """Read until the port is closed or lost; runs in the reader thread."""
        port, post = self._port, self._loop.call_soon_threadsafe
        with contextlib.suppress(RuntimeError):  # of a loop that is closed: nobody waits any more
            try:
                while not self._closing.is_set():
                    data = port.read(1)
                    if data:
                        data += port.read(port.in_waiting)
                        post(self._received, data)
            except (OSError, TypeError) as problem:  # TypeError: closed while it was being read
                if not self._closing.is_set():
                    post(self._lose, self._what_was_lost(problem))

    def _received(self, data: bytes) -> None:
        if not self._closing.is_set():
            self._on_data(data)

    def _lose(self, what: str) -> None:
        if self._is_lost or self._closing.is_set():
            return
        self._is_lost = True
        self._ignore()
        self._on_loss(what)

    def _what_was_lost(self, problem: Exception | str) -> str:
        return (
            f"serial line {self._name} was lost ({problem}): check the cable and the adapter, "
            "then open the amplifier again"
        )


def close_port(port: serial.Serial) -> None:
    """Give a port back, whatever became of it."""
    # pyserial does not close the socket of a server that hung up first, so that is done here.
    connection = connection_of(port)
    if connection is not None:
        connection.close()
    with contextlib.suppress(OSError):
        port.close()


def connection_of(port: serial.Serial) -> socket.socket | None:
    """The connection to a serial server that passes bytes on as they are; None for other ports."""
    is_server = str(port.port).startswith("socket://")
    return getattr(port, "_socket", None) if is_server else None


def remedy_of(problem: Exception) -> str | None:
    """What to do about a port that cannot be opened, where the system says enough about it."""
    code = getattr(problem, "errno", None)
    if code is None and isinstance(problem.__context__, OSError):
        code = problem.__context__.errno
    if code == errno.ENOENT:
        return "there is no such port; plug the adapter in and look at its name in /dev"
    if code in (errno.EACCES, errno.EPERM):
        return (
            "this user may not use it; add the user to the group that owns the port "
            "(often dialout: sudo usermod -aG dialout $USER) and log in again"
        )
    if code in (errno.EAGAIN, errno.EBUSY):
        return "another program has it open; close that one"
    return None
