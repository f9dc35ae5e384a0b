"""Fault dumps: what happened last before the plate was stopped, as files of JSON lines.

Messages of the amplifiers, calls of clients, decisions of the control loop and transitions are kept
unformatted in one ring; a thread writes them, since a disk may be slow or gone.
"""

import json
import logging
import math
import os
import threading
import time
from collections.abc import Iterable, Mapping
from dataclasses import asdict
from functools import partial
from operator import itemgetter
from pathlib import Path
from typing import Any

from controller.operation.operation_states import ENERGISED, DaemonState, Operation
from drivers.host.amplifier import Amplifier
from drivers.host.line import Line
from registry import threads

DUMP_PATTERN = "era-fault-*.jsonl"
"""File names of dumps of faults and losses; those of stops have `stop` for `fault`."""

MAX_DUMPS = 20  # files of a kind in a folder; the oldest are deleted
MAX_RECORDS = 700  # of all kinds: the last seconds under load, ten seconds at rest
MAX_LINE = 8192  # characters; a longer record is left out, and says so
_MAX_TEXT = 400  # characters of a cause
_MIN_INTERVAL = 1.0  # s; one dump for faults that come together
_DUMPED = (DaemonState.FAULT_REACTION_ACTIVE, DaemonState.FAULT, DaemonState.COMM_LOST)

_logger = logging.getLogger(__name__)


class FaultDumps:
    """Records of the last seconds, and their dumps in a folder; None for no dumps.

    One dump is written at a time, so that a hanging disk costs one thread.
    """

    def __init__(self, folder: Path | None) -> None:
        self._folder = folder
        self._ring: dict[object, Mapping[str, Any]] = {}  # by client and method, or by number
        self._count = 0
        self._written_at = dict.fromkeys(("fault", "stop"), -math.inf)
        self._writer: threading.Thread | None = None

    def note(self, record: Mapping[str, Any], key: object = None) -> None:
        """Keep a record, which has `time_s`, in place of the one of the same key, if it has one."""
        self._count += 1
        self._ring[self._count if key is None else key] = record
        if len(self._ring) > MAX_RECORDS:
            del self._ring[next(iter(self._ring))]

    def follow(self, amplifiers: Mapping[str, Amplifier]) -> None:
        """Record from now on the messages of amplifiers, by name, unless there is no folder."""
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
        """Record a message of an amplifier or line; never raises, since stops pass here."""
        try:
            where = {"time_s": threads.now(), "link": names.get(address, line)}
            self.note({**where, "way": way, "message": message, "content": content})
        except Exception:
            _logger.exception("recorder failed")

    def requested(self, client: str, method: str, at: float) -> dict[str, Any]:
        """Note that a client has called a method at a time [s]; return the record for the outcome.

        Keeps of each method of a client the last call, the number of calls and the last refusal, so
        that endless repetition does not displace other requests. Parameters, such as a lease, are
        not kept.
        """
        before = self._ring.pop((client, method), {"times": 0, "refused": ""})
        record = {
            "time_s": at,
            "request": method or "not read",
            "client": client,
            "times": before["times"] + 1,
            "outcome": "not replied yet",
            "refused": before["refused"],
        }
        self.note(record, (client, method))
        return record

    def state_changed(self, old: Operation, new: Operation) -> None:
        """Write a dump at a fault, a loss, or a stop of an armed plate, once a second at most."""
        now, folder, kind = threads.now(), self._folder, "fault"
        change = {"time_s": now, "state": f"{old.state} -> {new.state}", "cause": new.cause}
        self.note(change)
        if new.state is DaemonState.QUICK_STOP_ACTIVE and old.state in ENERGISED:
            kind = "stop"
        elif new.state not in _DUMPED:
            return
        if folder is None or now - self._written_at[kind] < _MIN_INTERVAL:
            return
        self._written_at[kind] = now
        if self._writer is not None and self._writer.is_alive():
            _logger.warning("dump in %s skipped: previous dump still being written", folder)
            return
        records = [*map(dict, self._ring.values())]  # a request's outcome may come meanwhile

        def write() -> None:
            try:
                path = write_dump(folder, records, cause=new.cause, kind=kind)
                _logger.info("dump: wrote %s", path)
            except Exception as error:
                _logger.warning("dump in %s failed: %s", folder, error)

        self._writer = threading.Thread(target=write, name="dump", daemon=True)
        self._writer.start()


def write_dump(
    folder: Path, records: Iterable[Mapping[str, Any]], *, cause: str, kind: str = "fault"
) -> Path:
    """Write records in order of time to a new file; keep the newest `MAX_DUMPS` of its kind.

    A file that cannot be written completely is deleted. Raises OSError.
    """
    pattern = DUMP_PATTERN.replace("fault", kind)
    folder.mkdir(parents=True, exist_ok=True)
    stamp = time.strftime("%Y%m%dT%H%M%S", time.gmtime())
    path = folder / pattern.replace("*", f"{stamp}-{time.monotonic_ns() % 10**9:09d}")
    owner_only = partial(os.open, mode=0o600)  # from its creation on
    opened = open(path, "x", encoding="utf-8", opener=owner_only)  # noqa: SIM115
    try:
        with opened as stream:
            stream.write(_line({"cause": cause, "unix_time_s": time.time()}))
            stream.writelines(map(_line, sorted(records, key=itemgetter("time_s"))))
    except Exception:
        path.unlink(missing_ok=True)
        raise
    # The new file may sort first: boards without a battery start in 1970.
    others = sorted(each for each in folder.glob(pattern) if each != path)
    for old in others[: max(0, len(others) + 1 - MAX_DUMPS)]:
        old.unlink(missing_ok=True)
    return path


def _line(record: Mapping[str, Any]) -> str:
    """Return a record as a line of JSON; numbers that are not finite become null."""
    known = {
        key: value[:_MAX_TEXT] if isinstance(value, str) else value
        for key, value in record.items()
        if value != ""
    }
    text = json.dumps(known, default=_content)
    if len(text) > MAX_LINE:
        text = json.dumps({"time_s": record["time_s"], "skipped": f"{len(text)} characters"})
    return json.dumps(json.loads(text, parse_constant=lambda _: None)) + "\n"


def _content(value: Any) -> object:
    """Return the JSON form of a message, a contact or a prediction."""
    return value.values if hasattr(value, "values") else asdict(value)
