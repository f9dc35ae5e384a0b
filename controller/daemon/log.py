"""The daemon's log: JSON lines, written by a thread.

Logging never blocks: lines go into a bounded queue; lines that do not fit or cannot be written are
counted. Each logging call in the code is limited to a few lines a second; the next line says how
many were skipped. JSON escapes control characters, so that messages cannot forge lines.
"""

import contextlib
import errno
import json
import logging
import os
import queue
import stat
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import TextIO

_MAX_QUEUED = 2000  # lines
_BURST = 5  # lines of one logging call at once
_RATE = 1.0  # 1/s after a burst
_MAX_MESSAGE = 2000  # characters
_CLOSE_TIMEOUT = 0.3  # s; a hanging disk must not delay the exit

_STANDARD_FIELDS = frozenset(logging.makeLogRecord({}).__dict__) | {
    "message",
    "asctime",
    "taskName",
}


class JsonFormatter(logging.Formatter):
    """Formats a record as JSON: time, level, logger, message, extra fields, traceback."""

    def format(self, record: logging.LogRecord) -> str:
        """Return one line of ASCII without control characters."""
        seconds = time.strftime("%Y-%m-%dT%H:%M:%S", time.gmtime(record.created))
        fields: dict[str, object] = {
            "time": f"{seconds}.{int(record.msecs):03d}Z",
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage()[:_MAX_MESSAGE],
        }
        for name, value in record.__dict__.items():
            if name not in _STANDARD_FIELDS:
                fields[name] = value if isinstance(value, int | float | str | None) else str(value)
        if record.exc_info:
            fields["traceback"] = self.formatException(record.exc_info)[-4 * _MAX_MESSAGE :]
        return json.dumps(fields)


def open_log_file(file: Path) -> TextIO:
    """Open a file to append to, a new one with mode 0600; raises OSError, also for a pipe."""
    # Non-blocking, so that a named pipe is refused instead of waited for.
    flags = os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_NONBLOCK | os.O_CLOEXEC
    stream = os.fdopen(os.open(file, flags, 0o600), "a", encoding="utf-8")
    if stat.S_ISFIFO(os.fstat(stream.fileno()).st_mode):
        stream.close()
        raise OSError(errno.EINVAL, "a named pipe", str(file))
    return stream


class RateLimitFilter(logging.Filter):
    """Limits the rate of records per logging call; clock [s].

    State transitions, marked by their topic, are rare by nature and not limited.
    """

    def __init__(self, *, clock: Callable[[], float] = time.monotonic) -> None:
        super().__init__()
        self._clock = clock
        self._buckets: dict[tuple[str, int], tuple[float, float, int]] = {}

    def filter(self, record: logging.LogRecord) -> bool:
        """Whether to write a record; its field `skipped` counts the records not written before."""
        if getattr(record, "topic", None) == "state":
            return True
        call, now = (record.pathname, record.lineno), self._clock()
        tokens, updated_at, skipped = self._buckets.get(call, (float(_BURST), now, 0))
        tokens = min(float(_BURST), tokens + _RATE * (now - updated_at))
        if tokens < 1:
            self._buckets[call] = (tokens, now, skipped + 1)
            return False
        self._buckets[call] = (tokens - 1, now, 0)
        if skipped:
            record.__dict__["skipped"] = skipped
        return True


class LogThread(logging.Handler):
    """Writes the log until it is closed; `lost` counts lines that could not be written.

    file: appended to; None for standard error. A failing file is reopened for every line, one that
    was renamed or removed before the next line. listener: called with records from level info on in
    the thread that logs them.
    """

    def __init__(self, file: Path | None) -> None:
        super().__init__()
        self.setFormatter(JsonFormatter())
        self.lost = 0
        self.listener: Callable[[logging.LogRecord], None] | None = None
        self._file = file
        self._lines: queue.Queue[str | None] = queue.Queue(_MAX_QUEUED)
        self._thread = threading.Thread(target=self._write_all, name="log", daemon=True)
        self._thread.start()

    def emit(self, record: logging.LogRecord) -> None:
        """Queue the line of a record; never blocks."""
        try:
            self._lines.put_nowait(self.format(record))
            if self.listener is not None and record.levelno >= logging.INFO:
                self.listener(record)
        except Exception:  # a full queue, or a failing log, must not stop the program
            self.lost += 1

    def close(self) -> None:
        """Write the queued lines, within a time limit."""
        super().close()
        try:
            self._lines.put(None, timeout=_CLOSE_TIMEOUT)
        except queue.Full:
            return
        self._thread.join(_CLOSE_TIMEOUT)

    def _write_all(self) -> None:
        stream: TextIO | None = None
        while (line := self._lines.get()) is not None:
            try:
                if stream is not None and self._is_replaced(stream):
                    self._close_file(stream)
                    stream = None
                if stream is None:
                    stream = self._open()
                stream.write(f"{line}\n")
                stream.flush()
            except (OSError, ValueError):
                self.lost += 1
                self._close_file(stream)
                stream = None  # the disk may have space again
        self._close_file(stream)

    def _open(self) -> TextIO:
        if self._file is None:
            return sys.stderr
        return open_log_file(self._file)

    def _is_replaced(self, stream: TextIO) -> bool:
        """Whether the file has another inode than the open one, as after its rotation."""
        if self._file is None:
            return False
        try:
            return os.fstat(stream.fileno()).st_ino != self._file.stat().st_ino
        except FileNotFoundError:
            return True

    def _close_file(self, stream: TextIO | None) -> None:
        if stream is not None and self._file is not None:
            with contextlib.suppress(OSError, ValueError):
                stream.close()


def start_log(file: Path | None, *, level: str) -> LogThread:
    """Send all records of this process from a level on to a file, or to standard error."""
    thread = LogThread(file)
    thread.addFilter(RateLimitFilter())
    root = logging.getLogger()
    root.handlers[:] = [thread]
    root.setLevel(level.upper())
    logging.raiseExceptions = False
    return thread
