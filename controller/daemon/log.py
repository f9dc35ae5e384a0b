"""The daemon's log: JSON, one object a line, written by a thread of its own.

Whoever logs never waits: lines go into a bounded queue, and what does not fit, or cannot be
written, is counted. Of lines from one place in the code a few a second are written, the next then
says how many were left out. Texts from outside are escaped by JSON, so that no line can be forged.
"""

import contextlib
import json
import logging
import queue
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import TextIO

_QUEUE = 2000  # lines that wait to be written
_BURST = 5  # lines from one place at once
_RATE = 1.0  # 1/s from then on
_LONGEST = 2000  # characters of a message
_END_TIMEOUT = 0.3  # s; a disk that hangs must not hold up the end

_STANDARD = frozenset(logging.makeLogRecord({}).__dict__) | {"message", "asctime", "taskName"}


class JsonFormatter(logging.Formatter):
    """A record as JSON: time, level, logger, message, what `extra` gave, and a traceback."""

    def format(self, record: logging.LogRecord) -> str:
        """One line without control characters; everything beyond ASCII is escaped."""
        seconds = time.strftime("%Y-%m-%dT%H:%M:%S", time.gmtime(record.created))
        said: dict[str, object] = {
            "time": f"{seconds}.{int(record.msecs):03d}Z",
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage()[:_LONGEST],
        }
        for name, value in record.__dict__.items():
            if name not in _STANDARD:
                said[name] = value if isinstance(value, int | float | str | None) else str(value)
        if record.exc_info:
            said["traceback"] = self.formatException(record.exc_info)[-4 * _LONGEST :]
        return json.dumps(said)


UNLIMITED = frozenset({"controller.daemon.supervisor"})
"""Loggers of which every line is written: changes of state, which the wire itself makes rare."""


class RateLimit(logging.Filter):
    """Lets a few records a second through for every place in the code; clock [s]."""

    def __init__(self, *, clock: Callable[[], float] = time.monotonic) -> None:
        super().__init__()
        self._clock = clock
        self._places: dict[tuple[str, int], tuple[float, float, int]] = {}

    def filter(self, record: logging.LogRecord) -> bool:
        """Whether a record is written; one that is says how many before it were not."""
        if record.name in UNLIMITED:
            return True
        place, now = (record.pathname, record.lineno), self._clock()
        allowance, seen_at, left_out = self._places.get(place, (float(_BURST), now, 0))
        allowance = min(float(_BURST), allowance + _RATE * (now - seen_at))
        if allowance < 1:
            self._places[place] = (allowance, now, left_out + 1)
            return False
        self._places[place] = (allowance - 1, now, 0)
        if left_out:
            record.__dict__["left_out"] = left_out
        return True


class LogThread:
    """Writes the log until it is closed; `lost` counts lines that could not be written.

    file: appended to; None for standard error. A file that fails is tried again with every line.
    listener: told of every record, in whatever thread it arose.
    """

    def __init__(self, file: Path | None) -> None:
        self.lost = 0
        self.listener: Callable[[logging.LogRecord], None] | None = None
        self._file = file
        self._lines: queue.Queue[str | None] = queue.Queue(_QUEUE)
        self._thread = threading.Thread(target=self._write_all, name="log", daemon=True)
        self._thread.start()

    def put(self, line: str) -> None:
        """Have a line written; never waits."""
        try:
            self._lines.put_nowait(line)
        except queue.Full:
            self.lost += 1

    def close(self) -> None:
        """Write what waits, but not for long."""
        try:
            self._lines.put(None, timeout=_END_TIMEOUT)
        except queue.Full:
            return
        self._thread.join(_END_TIMEOUT)

    def _write_all(self) -> None:
        stream: TextIO | None = None
        while (line := self._lines.get()) is not None:
            try:
                if stream is None:
                    stream = self._open()
                stream.write(f"{line}\n")
                stream.flush()
            except (OSError, ValueError):
                self.lost += 1
                self._leave(stream)
                stream = None  # a full disk may have room again
        self._leave(stream)

    def _open(self) -> TextIO:
        if self._file is None:
            return sys.stderr
        return self._file.open("a", encoding="utf-8")

    def _leave(self, stream: TextIO | None) -> None:
        if stream is not None and self._file is not None:
            with contextlib.suppress(OSError, ValueError):
                stream.close()


class LogHandler(logging.Handler):
    """Formats records and hands them to the thread."""

    def __init__(self, thread: LogThread) -> None:
        super().__init__()
        self._thread = thread
        self.setFormatter(JsonFormatter())

    def emit(self, record: logging.LogRecord) -> None:
        """Queue one record."""
        try:
            self._thread.put(self.format(record))
            if self._thread.listener is not None and record.levelno >= logging.INFO:
                self._thread.listener(record)
        except Exception:  # a log that fails must not end what it tells of
            self._thread.lost += 1


def start_log(file: Path | None, *, level: str) -> LogThread:
    """Send everything that is logged in this process there, from a level on; nowhere else."""
    thread = LogThread(file)
    handler = LogHandler(thread)
    handler.addFilter(RateLimit())
    root = logging.getLogger()
    root.handlers[:] = [handler]
    root.setLevel(level.upper())
    logging.raiseExceptions = False
    return thread
