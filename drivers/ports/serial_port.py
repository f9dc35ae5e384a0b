"""An open serial port. It never blocks the event loop.

A frame that the port does not take at once follows as soon as it takes it, unless a newer frame
replaces the rest of it: what the line delivers late must not delay a stop.
"""

import contextlib
import os
import select
import threading
from collections.abc import Callable
from typing import final

import serial

from drivers.errors import LinkError
from drivers.ports.device_port import DevicePort

READ_TIMEOUT = 0.1  # s; interval in which a reader thread notices its end
_READ_MAX = 4096


@final
class SerialPort(DevicePort):
    """A port of pyserial, written by the event loop, or by a thread where it has no descriptor."""

    kind = "serial line"

    def __init__(
        self,
        port: serial.Serial,
        name: str,
        on_data: Callable[[bytes], None],
        on_loss: Callable[[str], None],
    ) -> None:
        self._port = port
        self._unsent = b""
        descriptor = _descriptor(port)
        super().__init__(name, descriptor, on_data, on_loss)
        self._writer = None if descriptor is not None else _ThreadWriter(self, port.write)

    @property
    def is_blocked(self) -> bool:
        """Whether the port has not taken all bytes yet."""
        return bool(self._unsent) or (self._writer is not None and self._writer.is_blocked)

    def write(self, data: bytes) -> None:
        """Send bytes, as soon as the port takes them; raises LinkError."""
        if self._writer is not None:
            self._writer.write(data)
            return
        was_blocked, self._unsent = bool(self._unsent), data
        self._send()
        if was_blocked is not bool(self._unsent):
            self._watch_room(not was_blocked)

    def close(self) -> None:
        """Stop reading and writing; `wait_closed` closes the port."""
        self._unsent = b""
        self._watch_room(False)
        super().close()
        if self._writer is not None:
            self._writer.close()
            with contextlib.suppress(OSError, AttributeError):
                self._port.cancel_read()

    def read_watched(self) -> bytes:
        """Return what has come; OSError for the end, which an empty read of a terminal is not."""
        if self.descriptor is None:
            return b""
        try:
            data = os.read(self.descriptor, _READ_MAX)
        except BlockingIOError:
            return b""
        state = select.poll()
        state.register(self.descriptor, 0)  # a hang-up is told all the same
        if not data and state.poll(0):
            raise OSError("end of file")
        return data

    def read_waiting(self) -> bytes:
        """Return what comes within READ_TIMEOUT."""
        data = self._port.read(1)
        return bytes(data + self._port.read(self._port.in_waiting) if data else data)

    def shut(self) -> None:
        """Close the port."""
        self._port.close()

    def _send(self) -> None:
        """Write what the descriptor takes; raises LinkError."""
        if self.descriptor is None:
            raise self.lose(OSError("it is closed"))
        try:
            self._unsent = self._unsent[os.write(self.descriptor, self._unsent) :]
        except BlockingIOError:
            return
        except OSError as error:
            raise self.lose(error) from error

    def _watch_room(self, is_watched: bool) -> None:
        """Have the event loop send the rest when there is room, or no more."""
        if self.descriptor is None:
            return
        if is_watched:
            self.loop.add_writer(self.descriptor, self._send_rest)
        else:
            self.loop.remove_writer(self.descriptor)

    def _send_rest(self) -> None:
        with contextlib.suppress(LinkError):  # reported as a loss
            self._send()
        if not self._unsent:
            self._watch_room(False)


def _descriptor(port: serial.Serial) -> int | None:
    """Return the file descriptor of a port, if it has one."""
    if os.name != "posix":
        return None
    try:
        return int(port.fileno())
    except (OSError, AttributeError):  # UnsupportedOperation is an OSError
        return None


class _ThreadWriter:
    """Writes to a port by a function that blocks, in a thread."""

    def __init__(self, port: DevicePort, write: Callable[[bytes], object]) -> None:
        self._port, self._write = port, write
        self._changed = threading.Condition()
        self._unsent: bytes | None = None
        self._is_writing = self._is_closed = False
        threading.Thread(target=self._run, name=f"era-write {port.name}", daemon=True).start()

    @property
    def is_blocked(self) -> bool:
        return self._is_writing or self._unsent is not None

    def write(self, data: bytes) -> None:
        with self._changed:
            self._unsent = data
            self._changed.notify()

    def close(self) -> None:
        with self._changed:
            self._is_closed, self._unsent = True, None
            self._changed.notify()

    def _run(self) -> None:
        while True:
            with self._changed:
                self._is_writing = False
                while self._unsent is None and not self._is_closed:
                    self._changed.wait()
                data, self._unsent = self._unsent, None
                self._is_writing = True
            if data is None:
                return
            try:
                self._write(data)
            except OSError as error:
                with contextlib.suppress(RuntimeError):  # of a closed loop
                    self._port.loop.call_soon_threadsafe(self._port.lose, error)
                return
