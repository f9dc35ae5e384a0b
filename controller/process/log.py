"""The daemon's log, in JSON lines, written by a thread (`QueueListener`).

Logging never blocks: lines go into a bounded queue; lines that do not fit or cannot be written are
lost. Each logging call in the code is limited to a few lines a second; the next line reports the
number of skipped lines. JSON escapes control characters, so that messages cannot forge lines.

`RateLimiter` is a token bucket, which the API's server uses, too.
"""

import contextlib
import errno
import logging
import os
import queue
import stat
import sys
import time
from collections import Counter
from collections.abc import Callable
from io import FileIO
from logging.handlers import QueueHandler, QueueListener
from pathlib import Path
from typing import Any

from pythonjsonlogger.json import JsonFormatter

_MAX_QUEUED = 2000  # lines
_BURST = 5  # lines per logging call in a burst
_RATE = 1.0  # 1/s after a burst
_MAX_MESSAGE = 2000  # characters
_CLOSE_TIMEOUT = 0.3  # s; a hanging disk must not delay the exit


class RateLimiter:
    """Allows `per_second` actions per second, and a burst, by default as many; clock [s]."""

    def __init__(
        self, per_second: float, *, burst: float | None = None, clock: Callable[[], float]
    ) -> None:
        self._per_second = per_second
        self._burst = per_second if burst is None else burst
        self._clock = clock
        self._allowed = self._burst
        self._counted_at = clock()

    def take(self) -> bool:
        """Whether another action is allowed now; counts it."""
        now = self._clock()
        allowed = self._allowed + self._per_second * (now - self._counted_at)
        self._allowed = min(self._burst, allowed)
        self._counted_at = now
        if self._allowed < 1:
            return False
        self._allowed -= 1
        return True


class LogFormatter(JsonFormatter):
    """Formats a record as JSON: time, level, logger, message, extra fields, traceback.

    One line of ASCII without control characters.
    """

    converter = staticmethod(time.gmtime)
    default_time_format = "%Y-%m-%dT%H:%M:%S"
    default_msec_format = "%s.%03dZ"

    def __init__(self) -> None:
        names = {"asctime": "time", "levelname": "level", "name": "logger", "exc_info": "traceback"}
        fields = "asctime", "levelname", "name", "message"
        super().__init__(fields, rename_fields=names, json_default=str)

    def process_log_record(self, log_data: dict[str, Any]) -> dict[str, Any]:
        """Bound the lengths, and write the level in small letters."""
        log_data["level"] = log_data["level"].lower()
        log_data["message"] = log_data["message"][:_MAX_MESSAGE]
        if "traceback" in log_data:
            log_data["traceback"] = log_data["traceback"][-4 * _MAX_MESSAGE :]
        return log_data


def open_log_file(file: Path) -> FileIO:
    """Open a file to append to, a new one with mode 0600; raises OSError, also for a pipe."""
    # Non-blocking, so that a named pipe is refused instead of waited for.
    flags = os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_NONBLOCK | os.O_CLOEXEC
    stream = FileIO(os.open(file, flags, 0o600), "a")
    if stat.S_ISFIFO(os.fstat(stream.fileno()).st_mode):
        stream.close()
        raise OSError(errno.EINVAL, "a named pipe", str(file))
    return stream


class RateLimitFilter(logging.Filter):
    """Limits the rate of records per logging call; clock [s].

    State transitions, marked by a topic, are naturally rare and not limited.
    """

    def __init__(self, *, clock: Callable[[], float] = time.monotonic) -> None:
        super().__init__()
        self._clock = clock
        self._rates: dict[tuple[str, int], RateLimiter] = {}  # of each call
        self._skipped: Counter[tuple[str, int]] = Counter()  # since the last record of each call

    def filter(self, record: logging.LogRecord) -> bool:
        """Whether to write a record; its field `skipped` counts the records not written before."""
        if getattr(record, "topic", None) == "state":
            return True
        call = record.pathname, record.lineno
        if call not in self._rates:
            self._rates[call] = RateLimiter(_RATE, burst=_BURST, clock=self._clock)
        is_written = self._rates[call].take()
        if not is_written:
            self._skipped[call] += 1
        elif skipped := self._skipped.pop(call, 0):
            record.__dict__["skipped"] = skipped
        return is_written


class LineWriter(logging.Handler):
    """Appends each record's message to a file, or to standard error, as a whole line or not at all.

    file: opened again for each line, so it can be moved or deleted; None for standard error.
    """

    def __init__(self, file: Path | None) -> None:
        super().__init__()
        self._file = file

    def emit(self, record: logging.LogRecord) -> None:
        """Write a line, or lose it."""
        line = f"{record.getMessage()}\n"
        with contextlib.suppress(Exception):  # the disk may have space again
            if self._file is None:
                sys.stderr.write(line)
                sys.stderr.flush()
            else:
                content = line.encode()
                with open_log_file(self._file) as stream:
                    written = stream.write(content)
                    if written < len(content):
                        stream.truncate(stream.tell() - written)


class LogThread(QueueHandler):
    """Writes the log until it is closed, in a thread; file: None for standard error.

    subscriber: called with records from level info on in the thread that logs them.
    """

    def __init__(self, file: Path | None) -> None:
        self._lines = queue.Queue[logging.LogRecord](_MAX_QUEUED)
        super().__init__(self._lines)
        self.setFormatter(LogFormatter())
        self.subscriber: Callable[[logging.LogRecord], None] | None = None
        self._writer = QueueListener(self._lines, LineWriter(file))
        self._writer.start()

    def emit(self, record: logging.LogRecord) -> None:
        """Queue the line of a record; never blocks."""
        super().emit(record)
        with contextlib.suppress(Exception):
            if self.subscriber is not None and record.levelno >= logging.INFO:
                self.subscriber(record)

    def handleError(self, record: logging.LogRecord) -> None:  # noqa: N802
        """Lose the line: a full queue, or a failing log, stops nothing."""

    def close(self) -> None:
        """Write the queued lines, within a time limit."""
        super().close()
        with self._lines.all_tasks_done:
            self._lines.all_tasks_done.wait_for(
                lambda: not self._lines.unfinished_tasks, _CLOSE_TIMEOUT
            )
        with contextlib.suppress(queue.Full):
            self._writer.enqueue_sentinel()


def start_log(file: Path | None, *, level: str) -> LogThread:
    """Send all records of this process from a level on to a file, or to standard error."""
    thread = LogThread(file)
    thread.addFilter(RateLimitFilter())
    logging.basicConfig(handlers=[thread], level=level.upper(), force=True)
    return thread
