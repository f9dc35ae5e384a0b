"""Dumps of the last messages of the amplifiers at a fault or loss, written by a thread."""

import json
import logging
import os
import threading
import time
from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

from controller.operation.states import DaemonState, Operation
from drivers.host.amplifier import Amplifier
from drivers.host.line import Line
from registry import clock

DUMP_PATTERN = "era-fault-*.jsonl"
"""File names of dumps."""

MAX_DUMPS = 20  # files in a folder; the oldest are deleted
MAX_RECORDS = 400  # over all lines: the last seconds under load, ten seconds at rest
_MIN_INTERVAL = 1.0  # s; one dump for faults that come together
_DUMPED = (DaemonState.FAULT_REACTION_ACTIVE, DaemonState.FAULT, DaemonState.COMM_LOST)

_logger = logging.getLogger(__name__)


class FaultDumps:
    """Keeps the last messages unformatted, and writes them in a thread: a disk may be slow or gone.

    One dump at a time, so that a hanging disk costs one thread. folder: None for no dumps.
    """

    def __init__(self, folder: Path | None) -> None:
        self._folder = folder
        self.records: deque[Mapping[str, object]] = deque(maxlen=MAX_RECORDS)
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
        """Record a message of an amplifier or line; a stop depends on no record."""
        try:
            where = {"time_s": clock.now(), "link": names.get(address, line)}
            self.records.append({**where, "way": way, "message": message, "content": content})
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


def write_dump(folder: Path, records: Iterable[Mapping[str, object]], *, cause: str) -> Path:
    """Write records to a new file; keep the newest `MAX_DUMPS`; raises OSError.

    A file that cannot be written completely is deleted.
    """
    folder.mkdir(parents=True, exist_ok=True)
    stamp = time.strftime("%Y%m%dT%H%M%S", time.gmtime())
    path = folder / DUMP_PATTERN.replace("*", f"{stamp}-{time.monotonic_ns() % 10**9:09d}")
    opened = open(path, "x", encoding="utf-8", opener=_owner_only)  # noqa: SIM115
    try:
        with opened as stream:
            for line in ({"cause": cause, "unix_time_s": time.time()}, *records):
                known = {key: value for key, value in line.items() if value != ""}
                stream.write(json.dumps(known, default=_content) + "\n")
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


def _content(arrival: Any) -> object:
    """What an arrival on a wire says."""
    return arrival.values if hasattr(arrival, "values") else asdict(arrival)
