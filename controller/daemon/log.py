"""What the daemon writes: its log, in JSON lines, and dumps of the last messages at faults.

Both are written by threads. Logging never blocks: lines go into a bounded queue; lines that do not
fit or cannot be written are lost. Each logging call in the code is limited to a few lines a second;
the next line says how many were skipped. JSON escapes control characters, so that messages cannot
forge lines.
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
from collections import Counter, deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, TextIO

from controller.api.rate_limit import Rates
from controller.daemon.states import DaemonState, Operation
from drivers import clock
from drivers.host.amplifier import Amplifier
from drivers.host.line import Line

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


DUMP_PATTERN = "era-fault-*.jsonl"
"""File names of dumps."""

MAX_DUMPS = 20  # files in a folder; the oldest are deleted
MAX_RECORDS = 400  # over all lines: the last seconds under load, ten seconds at rest
_MIN_INTERVAL = 1.0  # s; one dump for faults that come together
_DUMPED = (DaemonState.FAULT_REACTION_ACTIVE, DaemonState.FAULT, DaemonState.COMM_LOST)

_logger = logging.getLogger(__name__)


class MessageRecord(NamedTuple):
    """One message: time [s], amplifier or line, way, name of the message, and its content."""

    time_s: float
    link: str
    way: str
    message: str
    content: object = ""


class FaultDumps:
    """Keeps the last messages unformatted, and writes them in a thread: a disk may be slow or gone.

    One dump at a time, so that a hanging disk costs one thread. folder: None for no dumps.
    """

    def __init__(self, folder: Path | None) -> None:
        self._folder = folder
        self.records: deque[MessageRecord] = deque(maxlen=MAX_RECORDS)
        self._written_at = float("-inf")
        self._writer: threading.Thread | None = None

    def follow(self, amplifiers: Mapping[str, Amplifier]) -> None:
        """Record the messages of the lines of amplifiers, by name, from now on, if for a dump."""
        if self._folder is None:
            return
        by_line: dict[Line, dict[int, str]] = {}
        for name, amplifier in amplifiers.items():
            by_line.setdefault(amplifier.line, {})[amplifier.address] = name
        for line, names in by_line.items():
            line.seen = partial(self._seen, line.name, names)

    def _seen(
        self,
        line: str,
        names: Mapping[int, str],
        way: str,
        address: int,
        message: str,
        content: object = "",
    ) -> None:
        """Record a message; a stop depends on no record."""
        try:
            link = names.get(address, line)
            self.records.append(MessageRecord(clock.now(), link, way, message, content))
        except Exception:
            _logger.exception("recorder failed")

    def state_changed(self, old: Operation, new: Operation) -> None:
        """Write a dump at a fault or loss, unless one was written within the last second."""
        folder, is_soon = self._folder, clock.now() - self._written_at < _MIN_INTERVAL
        if folder is None or new.state not in _DUMPED or is_soon:
            return
        self._written_at = clock.now()
        if self._writer is not None and self._writer.is_alive():
            _logger.warning("dump in %s skipped: previous dump still being written", folder)
            return
        records = [*self.records]

        def write() -> None:
            try:
                path = write_dump(folder, records, cause=new.cause)
                _logger.info("dump: wrote %s", path)
            except OSError as error:
                _logger.warning("dump in %s failed: %s", folder, error)

        self._writer = threading.Thread(target=write, name="dump", daemon=True)
        self._writer.start()


def write_dump(folder: Path, records: Iterable[MessageRecord], *, cause: str) -> Path:
    """Write records to a new file; keep the newest `MAX_DUMPS`; raises OSError.

    A file that cannot be written completely is deleted.
    """
    folder.mkdir(parents=True, exist_ok=True)
    stamp = time.strftime("%Y%m%dT%H%M%S", time.gmtime())
    path = folder / DUMP_PATTERN.replace("*", f"{stamp}-{time.monotonic_ns() % 10**9:09d}")
    opened = open(path, "x", encoding="utf-8", opener=_owner_only)  # noqa: SIM115
    try:
        with opened as stream:
            for line in ({"cause": cause, "unix_time_s": time.time()}, *map(_as_json, records)):
                stream.write(json.dumps(line, default=_content) + "\n")
    except OSError:
        path.unlink(missing_ok=True)
        raise
    # The new file may sort first: boards without a battery start in 1970.
    others = sorted(each for each in folder.glob(DUMP_PATTERN) if each != path)
    for old in others[: max(0, len(others) + 1 - MAX_DUMPS)]:
        old.unlink(missing_ok=True)
    return path


def _owner_only(path: str, flags: int) -> int:
    """Open a file with mode 0600 from its creation on."""
    return os.open(path, flags, 0o600)


def _as_json(record: MessageRecord) -> dict[str, object]:
    return {key: value for key, value in record._asdict().items() if value != ""}


def _content(arrival: Any) -> object:
    """What an arrival on a wire says."""
    return arrival.values if hasattr(arrival, "values") else asdict(arrival)
