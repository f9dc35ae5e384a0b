"""The daemon's log, in JSON lines, written by a thread.

Logging never blocks: lines go into a bounded queue; lines that do not fit or cannot be written are
lost. Each logging call in the code is limited to a few lines a second; the next line says how many
were skipped. JSON escapes control characters, so that messages cannot forge lines.
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
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import TextIO

from controller.process.rate_limit import Rates

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
        self._rates = Rates(_RATE, burst=_BURST, clock=clock)
        self._skipped: Counter[tuple[str, int]] = Counter()  # since the last record of each call

    def filter(self, record: logging.LogRecord) -> bool:
        """Whether to write a record; its field `skipped` counts the records not written before."""
        if getattr(record, "topic", None) == "state":
            return True
        call = record.pathname, record.lineno
        is_written = self._rates.of(call).take()
        if not is_written:
            self._skipped[call] += 1
        elif skipped := self._skipped.pop(call, 0):
            record.__dict__["skipped"] = skipped
        return is_written


class LogThread(logging.Handler):
    """Writes the log until it is closed; `lines` are those that wait for that.

    file: opened to append each line, whatever has become of it; None for standard error. listener:
    called with records from level info on in the thread that logs them.
    """

    def __init__(self, file: Path | None) -> None:
        super().__init__()
        self.setFormatter(JsonFormatter())
        self.listener: Callable[[logging.LogRecord], None] | None = None
        self.lines: queue.Queue[str | None] = queue.Queue(_MAX_QUEUED)
        self._file = file
        self._thread = threading.Thread(target=self._write_all, name="log", daemon=True)
        self._thread.start()

    def emit(self, record: logging.LogRecord) -> None:
        """Queue the line of a record; never blocks."""
        with contextlib.suppress(Exception):  # a full queue, or a failing log, stops nothing
            self.lines.put_nowait(self.format(record))
        with contextlib.suppress(Exception):  # which is told all the same
            if self.listener is not None and record.levelno >= logging.INFO:
                self.listener(record)

    def close(self) -> None:
        """Write the queued lines, within a time limit."""
        super().close()
        with contextlib.suppress(queue.Full):
            self.lines.put(None, timeout=_CLOSE_TIMEOUT)
            self._thread.join(_CLOSE_TIMEOUT)

    def _write_all(self) -> None:
        errors = contextlib.nullcontext(sys.stderr)
        while (line := self.lines.get()) is not None:
            with (
                contextlib.suppress(OSError, ValueError),  # the disk may have space again
                errors if self._file is None else open_log_file(self._file) as stream,
            ):
                stream.write(f"{line}\n")
                stream.flush()


def start_log(file: Path | None, *, level: str) -> LogThread:
    """Send all records of this process from a level on to a file, or to standard error."""
    thread = LogThread(file)
    thread.addFilter(RateLimitFilter())
    root = logging.getLogger()
    root.handlers[:] = [thread]
    root.setLevel(level.upper())
    logging.raiseExceptions = False
    return thread
