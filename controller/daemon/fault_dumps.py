"""Fault dumps: the last messages of all links as a file of JSON lines."""

import json
import logging
import os
import threading
import time
from collections.abc import Iterable
from pathlib import Path

from controller.daemon.message_recorder import MessageRecord, MessageRecorder
from drivers import clock

DUMP_PATTERN = "era-fault-*.jsonl"
"""File names of dumps."""

MAX_DUMPS = 20  # files in a folder; the oldest are deleted
_MIN_INTERVAL = 1.0  # s; one dump for faults that come together

_logger = logging.getLogger(__name__)


class FaultDumps:
    """Writes recorded messages in a thread, since a disk may be slow, full or gone.

    One dump at a time, so that a hanging disk costs one thread.
    """

    def __init__(self, recorder: MessageRecorder) -> None:
        self._recorder = recorder
        self._written_at = float("-inf")
        self._writer: threading.Thread | None = None

    def write(self, folder: Path, *, cause: str) -> None:
        """Write a dump unless one was written within the last second."""
        if clock.now() - self._written_at < _MIN_INTERVAL:
            return
        self._written_at = clock.now()
        if self._writer is not None and self._writer.is_alive():
            _logger.warning("dump in %s skipped: previous dump still being written", folder)
            return
        records = self._recorder.records()

        def write() -> None:
            try:
                path = write_dump(folder, records, cause=cause)
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
            stream.write(json.dumps({"cause": cause, "unix_time_s": time.time()}) + "\n")
            for record in records:
                stream.write(json.dumps(_as_json(record)) + "\n")
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
    line: dict[str, object] = {
        "time_s": round(record.time, 6),
        "link": record.link,
        "way": record.direction,
        "message": record.message,
    }
    if record.content:
        line["content"] = record.content
    return line
