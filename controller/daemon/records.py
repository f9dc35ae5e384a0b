"""The last messages of every link, kept in memory, and written to a file when a fault has come.

They are what the frames meant, on whatever wire, with their times; the file is JSON, one a line.
"""

import json
import os
import time
from collections import deque
from collections.abc import Callable, Iterable
from contextlib import AbstractContextManager
from dataclasses import asdict, is_dataclass
from enum import Enum
from pathlib import Path
from typing import NamedTuple

from drivers import clock
from drivers.backend import Backend
from drivers.protocol.messages import Broadcast, Event, Reply, Request, Status
from drivers.statistics import WireCounters

KEPT = 400  # messages over all links: the last seconds under load, ten at rest
DUMPS = "era-fault-*.jsonl"
"""What the files with the last messages are called."""


class Record(NamedTuple):
    """One message: when [s], on which link, which way, and what; what: any dataclass, or a text."""

    time: float
    link: str
    way: str
    what: object


class Recorder:
    """Keeps the last messages; nothing is worked out of them until they are asked for."""

    def __init__(self) -> None:
        self._records: deque[Record] = deque(maxlen=KEPT)

    def note(self, link: str, way: str, what: object) -> None:
        """Keep one, in place of the oldest."""
        self._records.append(Record(clock.now(), link, way, what))

    def last(self) -> list[Record]:
        """All that are kept, the oldest first."""
        return list(self._records)


class RecordedBackend(Backend):
    """A backend whose messages are kept; `status` is the last one that was read, with its time."""

    def __init__(self, inner: Backend, name: str, recorder: Recorder) -> None:
        self.status: tuple[Status, float] | None = None
        self._inner = inner
        self._name = name
        self._recorder = recorder

    async def open(self) -> None:
        """As the inner one."""
        self._recorder.note(self._name, "open", "")
        await self._inner.open()

    async def close(self) -> None:
        """As the inner one."""
        self._recorder.note(self._name, "close", "")
        await self._inner.close()

    async def exchange(self, request: Request, *, timeout: float) -> Reply:
        """As the inner one; request, reply or what went wrong are kept."""
        self._recorder.note(self._name, "out", request)
        try:
            reply = await self._inner.exchange(request, timeout=timeout)
        except BaseException as error:
            self._recorder.note(self._name, "none", f"{type(error).__name__}: {error}")
            raise
        self._recorder.note(self._name, "in", reply)
        if isinstance(reply, Status):
            self.status = (reply, clock.now())
        return reply

    @property
    def last_sent(self) -> float:
        """Of the inner one."""
        return self._inner.last_sent

    @property
    def counters(self) -> WireCounters:
        """Of the inner one."""
        return self._inner.counters

    def listen(self, on_event: Callable[[Event], None], on_loss: Callable[[str], None]) -> None:
        """As the inner one; events and the loss are kept."""

        def told(event: Event) -> None:
            self._recorder.note(self._name, "event", event)
            on_event(event)

        def lost(what: str) -> None:
            self._recorder.note(self._name, "lost", what)
            on_loss(what)

        self._inner.listen(told, lost)

    @property
    def bus(self) -> str | None:
        """Of the inner one."""
        return self._inner.bus

    @property
    def is_unsent(self) -> bool:
        """Of the inner one."""
        return self._inner.is_unsent

    def silencing(self, request: Request) -> AbstractContextManager[None]:
        """As the inner one."""
        return self._inner.silencing(request)

    async def broadcast(self, request: Broadcast) -> None:
        """As the inner one."""
        self._recorder.note(self._name, "out", request)
        await self._inner.broadcast(request)

    def round_trip(self, channels: int) -> float:
        """Of the inner one."""
        return self._inner.round_trip(channels)

    def commit_time(self) -> float:
        """Of the inner one."""
        return self._inner.commit_time()

    def loading_time(self, knots: int) -> float:
        """Of the inner one."""
        return self._inner.loading_time(knots)


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
