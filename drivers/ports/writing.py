"""Writing to a serial port without ever blocking the event loop.

A frame that the port does not take at once follows as soon as it takes it, unless a newer frame
replaces the rest of it: what the line delivers late must not delay a stop.
"""

import asyncio
import contextlib
import os
import threading
from collections.abc import Callable
from typing import Protocol

import serial


class PortWriter(Protocol):
    """Writer of one port; errors are reported to the callback of its construction."""

    @property
    def is_blocked(self) -> bool:
        """Whether the port has not taken all bytes yet."""

    def write(self, data: bytes) -> None:
        """Write, now or as soon as the port takes it; OSError if it is lost."""

    def close(self) -> None:
        """Discard unsent bytes."""


def make_writer(port: serial.Serial, on_error: Callable[[OSError], None]) -> PortWriter:
    """Make the writer of a port; on_error: called in the event loop, once."""
    opened = descriptor(port)
    if opened is not None:
        return _DescriptorWriter(opened, on_error)
    return _ThreadWriter(lambda data: port.write(data), on_error, name=f"era-write {port.name}")


def descriptor(port: serial.Serial) -> int | None:
    """Return the file descriptor of a port, if it has one."""
    if os.name != "posix":
        return None
    try:
        return int(port.fileno())
    except (OSError, AttributeError):  # UnsupportedOperation is an OSError
        return None


def write_some(opened: int, data: bytes) -> bytes:
    """Write what a non-blocking descriptor takes and return the rest; OSError if it is lost."""
    try:
        return data[os.write(opened, data) :]
    except BlockingIOError:
        return data


class _DescriptorWriter:
    """Writes to a non-blocking descriptor, watched by the event loop while it is blocked."""

    def __init__(self, opened: int, on_error: Callable[[OSError], None]) -> None:
        self._descriptor = opened
        self._on_error = on_error
        self._loop = asyncio.get_running_loop()
        self._unsent = b""

    @property
    def is_blocked(self) -> bool:
        return bool(self._unsent)

    def write(self, data: bytes) -> None:
        was_blocked, self._unsent = bool(self._unsent), write_some(self._descriptor, data)
        if self._unsent and not was_blocked:
            self._loop.add_writer(self._descriptor, self._flush)
        elif was_blocked and not self._unsent:
            self._loop.remove_writer(self._descriptor)

    def close(self) -> None:
        if self._unsent:
            self._unsent = b""
            self._loop.remove_writer(self._descriptor)

    def _flush(self) -> None:
        try:
            self._unsent = write_some(self._descriptor, self._unsent)
        except OSError as error:
            self.close()
            self._on_error(error)
            return
        if not self._unsent:
            self._loop.remove_writer(self._descriptor)


class _ThreadWriter:
    """Writes by a function that blocks, in a thread of this name."""

    def __init__(
        self, write: Callable[[bytes], object], on_error: Callable[[OSError], None], *, name: str
    ) -> None:
        self._write = write
        self._on_error = on_error
        self._loop = asyncio.get_running_loop()
        self._changed = threading.Condition()
        self._unsent: bytes | None = None
        self._is_writing = self._is_closed = False
        threading.Thread(target=self._run, name=name, daemon=True).start()

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
                    self._loop.call_soon_threadsafe(self._on_error, error)
                return
