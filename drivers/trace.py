"""Trace of everything on the wires, for `--trace FILE`.

Each line has its time and its kind:

    wire      every frame, both directions: in hexadecimal, with its meaning
    request   every request of an amplifier with its reply, its error and its duration

A line is formatted and written by a thread of its own. Tracing never waits for it: records beyond
MAX_PENDING_RECORDS are dropped, and their number is written as soon as there is room.
"""

import logging
import os
import threading
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from enum import StrEnum
from pathlib import Path
from typing import TextIO

from drivers.errors import CommandError

MAX_PENDING_RECORDS = 20_000
"""Records kept for the thread: more than a second of the fastest wire."""

_POLL_INTERVAL = 0.05  # s
_writers: "list[TraceWriter]" = []


class Direction(StrEnum):
    """Direction of a frame."""

    OUT = ">"
    IN = "<"


is_active = _writers.__len__
"""Number of active traces; check it before making the bytes of a frame."""


def frame(direction: Direction, data: bytes, where: str, decode: Callable[[], str]) -> None:
    """Trace a frame of a wire; its name is a URL or port.

    decode: returns the meaning; called later in the writing thread, so its arguments must not
    change. Costs a comparison while nothing is traced.
    """
    for writer in _writers:
        writer.add("wire", lambda: f"{where} {direction} {data.hex(' ')}  {_meaning(decode)}")


def request(requested: object, outcome: object, duration: float) -> None:
    """Trace a request with its reply or error, and its duration [s]."""
    for writer in _writers:
        writer.add("request", lambda: f"{requested} -> {outcome!r} in {duration * 1e3:.1f} ms")


def _meaning(decode: Callable[[], str]) -> str:
    try:
        return decode()
    except Exception as error:  # a damaged frame must not end the trace
        return f"not decoded: {error}"


@contextmanager
def tracing(path: Path) -> Iterator[None]:
    """Append all traces to a file while the context lasts; raises CommandError."""
    try:
        # Non-blocking, so that a FIFO is refused instead of waited for.
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_NONBLOCK, 0o600)
        file = os.fdopen(descriptor, "a", encoding="utf-8")
    except OSError as error:
        raise CommandError(f"trace file {path} cannot be written: {error.strerror}") from error
    if not path.is_file():
        file.close()
        raise CommandError(f"trace file must be a regular file, got {path}")
    writer = TraceWriter(file)
    _writers.append(writer)
    try:
        yield
    finally:
        _writers.remove(writer)
        writer.close()


class TraceWriter:
    """Writes lines to a file in a thread; `dropped` counts those for which there was no room."""

    def __init__(self, file: TextIO) -> None:
        self.dropped = 0
        self._file = file
        self._pending: deque[tuple[datetime, str, Callable[[], str]]] = deque()
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._run, name="trace", daemon=True)
        self._thread.start()

    def add(self, kind: str, text: Callable[[], str]) -> None:
        """Queue a line of a kind; its text is made when it is written."""
        if len(self._pending) < MAX_PENDING_RECORDS:
            self._pending.append((datetime.now(UTC), kind, text))
        else:
            self.dropped += 1

    def close(self) -> None:
        """Write pending lines and close the file; waits for a slow file for at most a second."""
        self._ending.set()
        self._thread.join(1.0)

    def _run(self) -> None:
        reported = 0
        is_last = False
        while not is_last:
            is_last = self._ending.wait(_POLL_INTERVAL)
            try:
                while self._pending:
                    moment, kind, text = self._pending.popleft()
                    time = moment.isoformat(timespec="microseconds")
                    self._file.write(f"{time} {kind} {text()}\n")
                if self.dropped > reported:
                    self._file.write(f"trace: {self.dropped - reported} records dropped\n")
                    reported = self.dropped
                self._file.flush()
            except OSError as error:
                self.dropped += len(self._pending)
                self._pending.clear()
                logging.getLogger(__name__).warning("trace: not written: %s", error)
        with suppress(OSError):  # of a disk that is still full
            self._file.close()
