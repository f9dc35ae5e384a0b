"""The last messages of every link, kept in memory: what the frames meant, with their times."""

from collections import deque
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import NamedTuple

from drivers import clock
from drivers.backend import Backend
from drivers.errors import LinkError
from drivers.protocol.messages import AmplifierEvent, Broadcast, Reply, Request, Status
from drivers.protocol.wire_times import WireTimes
from drivers.statistics import WireCounters

KEPT = 400  # messages over all links: the last seconds under load, ten at rest


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
    """A backend whose messages are kept.

    status: the last that was read since it was opened; heard_at [s]: when the last one was read.
    is_missing: whether it could not be opened, or did not answer, when that was tried last.
    """

    def __init__(self, inner: Backend, name: str, recorder: Recorder) -> None:
        self.status: Status | None = None
        self.heard_at: float | None = None
        self.is_missing = False
        self._inner = inner
        self._name = name
        self._recorder = recorder

    async def open(self) -> None:
        """As the inner one."""
        self._recorder.note(self._name, "open", "")
        self.status = None  # how it was before says nothing of how it is
        try:
            await self._inner.open()
        except LinkError:
            self.is_missing = True
            raise

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
            self.is_missing = self.is_missing or isinstance(error, LinkError)
            raise
        self.is_missing = False
        self._recorder.note(self._name, "in", reply)
        if isinstance(reply, Status):
            self.status, self.heard_at = reply, clock.now()
        return reply

    @property
    def last_sent(self) -> float:
        """Of the inner one."""
        return self._inner.last_sent

    @property
    def counters(self) -> WireCounters:
        """Of the inner one."""
        return self._inner.counters

    def listen(
        self, on_event: Callable[[AmplifierEvent], None], on_loss: Callable[[str], None]
    ) -> None:
        """As the inner one; events and the loss are kept."""

        def told(event: AmplifierEvent) -> None:
            self._recorder.note(self._name, "event", event)
            on_event(event)

        def lost(what: str) -> None:
            self._recorder.note(self._name, "lost", what)
            self.is_missing = True
            on_loss(what)

        self._inner.listen(told, lost)

    @property
    def bus(self) -> str | None:
        """Of the inner one."""
        return self._inner.bus

    @property
    def takes_turns(self) -> bool:
        """Of the inner one."""
        return self._inner.takes_turns

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

    @property
    def wire_times(self) -> WireTimes:
        """Of the inner one."""
        return self._inner.wire_times
