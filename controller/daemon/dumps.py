"""The last messages of all links in a file, JSON, one a line, when a fault has come."""

import json
import logging
import os
import threading
import time
from collections.abc import Iterable
from dataclasses import asdict, is_dataclass
from enum import Enum
from pathlib import Path

from controller.daemon.records import Record, Recorder
from drivers import clock

DUMPS = "era-fault-*.jsonl"
"""What the files with the last messages are called."""

_PAUSE = 1.0  # s; between two dumps, for faults come in company

_logger = logging.getLogger(__name__)


class Dumps:
    """Writes what a recorder has kept, in a thread: a disk may be slow, full or gone.

    One at a time: on a disk that hangs, faults would leave a thread each.
    """

    def __init__(self, recorder: Recorder) -> None:
        self._recorder = recorder
        self._written_at = float("-inf")
        self._writing: threading.Thread | None = None

    def write(self, folder: Path, *, cause: str, keep: int) -> None:
        """Write a dump, unless there was one just now; the newest `keep` files stay."""
        if clock.now() - self._written_at < _PAUSE:
            return
        self._written_at = clock.now()
        if self._writing is not None and self._writing.is_alive():
            _logger.warning("no dump in %s: the one before is still being written", folder)
            return
        records = self._recorder.last()

        def write() -> None:
            try:
                path = write_dump(folder, records, cause=cause, keep=keep)
                _logger.info("the last messages are in %s", path)
            except OSError as error:
                _logger.warning("the last messages could not be written to %s: %s", folder, error)

        self._writing = threading.Thread(target=write, name="dump", daemon=True)
        self._writing.start()


def write_dump(folder: Path, records: Iterable[Record], *, cause: str, keep: int) -> Path:
    """Write records to a new file, and take away the oldest beyond `keep`; raises OSError.

    Where there is no room for all of it, nothing is left of it. To be called in a thread of its
    own: a disk may be slow.
    """
    folder.mkdir(parents=True, exist_ok=True)
    stamp = time.strftime("%Y%m%dT%H%M%S", time.gmtime())
    path = folder / DUMPS.replace("*", f"{stamp}-{time.monotonic_ns() % 10**9:09d}")
    opened = open(path, "x", encoding="utf-8", opener=_for_the_owner)  # noqa: SIM115
    try:
        with opened as stream:
            stream.write(json.dumps({"cause": cause, "unix_time_s": time.time()}) + "\n")
            for record in records:
                stream.write(json.dumps(_as_json(record)) + "\n")
    except OSError:
        path.unlink(missing_ok=True)
        raise
    # By its name this one may be the oldest: clocks are set, and some boards begin in 1970.
    others = sorted(each for each in folder.glob(DUMPS) if each != path)
    for old in others[: max(0, len(others) + 1 - keep)]:
        old.unlink(missing_ok=True)
    return path


def _for_the_owner(path: str, flags: int) -> int:
    """Open a file that nobody else could open before it had something in it."""
    return os.open(path, flags, 0o600)


def _as_json(record: Record) -> dict[str, object]:
    what = record.what
    said: dict[str, object] = {"time_s": round(record.time, 6), "link": record.link}
    said |= {"way": record.way, "message": type(what).__name__}
    if is_dataclass(what) and not isinstance(what, type):
        said["content"] = _plain(asdict(what))
    elif what:
        said["content"] = str(what)
    return said


def _plain(value: object) -> object:
    if isinstance(value, dict):
        return {str(key): _plain(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(each) for each in value]
    return value.name if isinstance(value, Enum) else value
