"""A ring buffer of the last messages of all links, for fault dumps."""

import logging
from collections import deque
from collections.abc import Callable
from typing import NamedTuple

from drivers import clock
from drivers.backend import Backend
from drivers.errors import LinkError
from drivers.protocol.messages import AmplifierEvent, Broadcast, Reply, Request, Status
from drivers.protocol.wire_times import WireTimes
from drivers.statistics import WireCounters

MAX_RECORDS = 400  # over all links: the last seconds under load, ten seconds at rest

_logger = logging.getLogger(__name__)


class MessageRecord(NamedTuple):
    """One message: time [s], link, direction, and the message (a dataclass) or a text."""

    time: float
    link: str
    direction: str
    message: object


class MessageRecorder:
    """Keeps the last messages unformatted."""

    def __init__(self) -> None:
        self._records: deque[MessageRecord] = deque(maxlen=MAX_RECORDS)

    def add(self, link: str, direction: str, message: object) -> None:
        """Add a message, replacing the oldest if full."""
        self._records.append(MessageRecord(clock.now(), link, direction, message))

    def records(self) -> list[MessageRecord]:
        """All records, oldest first."""
        return list(self._records)


class RecordedBackend(Backend):
    """Wraps a backend and records its messages.

    status: the last one read since opening; status_at [s]: when it was read; is_missing: whether
    the last attempt to open it or to exchange a message failed.
    """

    def __init__(self, inner: Backend, name: str, recorder: MessageRecorder) -> None:
        self.status: Status | None = None
        self.status_at: float | None = None
        self.is_missing = False
        self._inner = inner
        self._name = name
        self._add = recorder.add

    def _record(self, direction: str, message: object) -> None:
        """Record a message; a stop depends on no record."""
        try:
            self._add(self._name, direction, message)
        except Exception:
            _logger.exception("recorder failed")

    async def open(self) -> None:
        """Open the backend."""
        self._record("open", "")
        self.status = None  # may have changed meanwhile
        try:
            await self._inner.open()
        except LinkError:
            self.is_missing = True
            raise

    async def close(self) -> None:
        """Close the backend."""
        self._record("close", "")
        await self._inner.close()

    async def exchange(self, request: Request, *, timeout: float) -> Reply:
        """Exchange a request; record it and its reply or error."""
        self._record("out", request)
        try:
            reply = await self._inner.exchange(request, timeout=timeout)
        except BaseException as error:
            self._record("none", f"{type(error).__name__}: {error}")
            self.is_missing = self.is_missing or isinstance(error, LinkError)
            raise
        self.is_missing = False
        self._record("in", reply)
        if isinstance(reply, Status):
            self.status, self.status_at = reply, clock.now()
        return reply

    def listen(
        self, on_event: Callable[[AmplifierEvent], None], on_loss: Callable[[str], None]
    ) -> None:
        """Set the callbacks; events and the loss of the link are recorded."""

        def event_received(event: AmplifierEvent) -> None:
            self._record("event", event)
            on_event(event)

        def link_lost(reason: str) -> None:
            self._record("lost", reason)
            self.is_missing = True
            on_loss(reason)

        self._inner.listen(event_received, link_lost)

    async def broadcast(self, request: Broadcast) -> None:
        """Broadcast a request on the bus; record it."""
        self._record("out", request)
        await self._inner.broadcast(request)

    @property
    def last_sent_at(self) -> float:
        """See `Backend.last_sent_at`."""
        return self._inner.last_sent_at

    @property
    def counters(self) -> WireCounters:
        """See `Backend.counters`."""
        return self._inner.counters

    @property
    def bus(self) -> str | None:
        """See `Backend.bus`."""
        return self._inner.bus

    @property
    def carries_sessions(self) -> bool:
        """See `Backend.carries_sessions`."""
        return self._inner.carries_sessions

    @property
    def wire_times(self) -> WireTimes:
        """See `Backend.wire_times`."""
        return self._inner.wire_times
