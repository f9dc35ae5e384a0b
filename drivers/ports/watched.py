"""An open serial port, read by the event loop or by a thread.

The event loop watches the port's file descriptor; if there is none (as on Windows), a thread
reads the port.
"""

import asyncio
import contextlib
import errno
import os
import select
import socket
import threading
from collections.abc import Callable
from typing import final

import serial

from drivers.errors import LinkError
from drivers.ports.writing import descriptor, make_writer
from drivers.threads import close_in_thread

READ_TIMEOUT = 0.1  # s; interval in which a reader thread notices its end
_READ_MAX = 4096


@final
class WatchedPort:
    """A pyserial port opened with these timeouts; implements `Port`.

    on_data: called with received bytes; on_loss: called once with the cause of a loss.
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
        self._writer = make_writer(port, lambda error: self._lose(self._loss_message(error)))
        if self._descriptor is not None:
            self._loop.add_reader(self._descriptor, self._readable)
            return
        self._thread = threading.Thread(target=self._read, name=f"era-serial {name}", daemon=True)
        self._thread.start()

    def write(self, data: bytes) -> None:
        """Send bytes, as soon as the port takes them; raises LinkError."""
        try:
            self._writer.write(data)
        except OSError as error:
            cause = self._loss_message(error)
            self._lose(cause)
            raise LinkError(cause) from error

    @property
    def is_blocked(self) -> bool:
        """Whether the port has not taken all bytes yet."""
        return self._writer.is_blocked

    def poll(self) -> None:
        """Hand over what has come and was not read yet; a reader thread has done so."""
        self._readable()

    def close(self) -> None:
        """Stop reading and writing; `wait_closed` closes the port."""
        self._ignore()
        self._closing.set()
        if self._thread is not None and hasattr(self._port, "cancel_read"):
            with contextlib.suppress(OSError):
                self._port.cancel_read()

    async def wait_closed(self) -> None:
        """Wait until reader and port are closed, but not for a device that hangs."""
        # The system waits half a minute for a device that takes no more bytes.
        await close_in_thread(self._close_port, name=f"era-close {self._name}")

    def _close_port(self) -> None:
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
        except OSError as error:
            self._lose(self._loss_message(error))
            return
        if data:
            self._on_data(data)
        elif self._is_hung_up():
            self._lose(self._loss_message("end of file"))

    def _is_hung_up(self) -> bool:
        """Whether an empty read is the end: a terminal without data has one as well."""
        if self._descriptor is None or connection_of(self._port) is not None:
            return True
        state = select.poll()
        state.register(self._descriptor, 0)  # a hang-up is told all the same
        return bool(state.poll(0))

    def _ignore(self) -> None:
        self._writer.close()
        watched, self._descriptor = self._descriptor, None
        if watched is not None:
            self._loop.remove_reader(watched)

    def _read(self) -> None:
        """Read until the port is closed or lost; reader thread."""
        port, post = self._port, self._loop.call_soon_threadsafe
        with contextlib.suppress(RuntimeError):  # of a closed loop
            try:
                while not self._closing.is_set():
                    data = port.read(1)
                    if data:
                        data += port.read(port.in_waiting)
                        post(self._received, data)
            except (OSError, TypeError) as error:  # TypeError: closed during a read
                if not self._closing.is_set():
                    post(self._lose, self._loss_message(error))

    def _received(self, data: bytes) -> None:
        if not self._closing.is_set():
            self._on_data(data)

    def _lose(self, cause: str) -> None:
        if self._is_lost or self._closing.is_set():
            return
        self._is_lost = True
        self._ignore()
        self._on_loss(cause)

    def _loss_message(self, error: Exception | str) -> str:
        return (
            f"serial line {self._name} was lost ({error}): check the cable and the adapter, "
            "then open the amplifier again"
        )


def close_port(port: serial.Serial) -> None:
    """Close a port, also a lost one."""
    # pyserial does not close the socket if the server closed first.
    connection = connection_of(port)
    if connection is not None:
        connection.close()
    with contextlib.suppress(OSError):
        port.close()


def connection_of(port: serial.Serial) -> socket.socket | None:
    """Return the connection to a raw TCP serial server; None for other ports."""
    is_server = str(port.port).startswith("socket://")
    return getattr(port, "_socket", None) if is_server else None


def remedy_of(error: Exception) -> str | None:
    """Return the remedy for an opening error by its error code, if there is one."""
    cause: BaseException | None = error
    code = None
    while cause is not None and code is None:
        code = getattr(cause, "errno", None)
        cause = cause.__cause__ or cause.__context__
    if code == errno.ENOENT:
        return "no such port; plug in the adapter and check its name in /dev"
    if code in (errno.EACCES, errno.EPERM):
        return (
            "no permission; add the user to the group that owns the port "
            "(often dialout: sudo usermod -aG dialout $USER) and log in again"
        )
    if code in (errno.EAGAIN, errno.EBUSY):
        return "in use by another program; close that one"
    return None
