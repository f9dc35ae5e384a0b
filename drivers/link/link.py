"""One request at a time over one backend, retried if there is no reply.

A lost link stays lost until it is reopened: every request raises LinkError at once.
"""

import asyncio
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import asdict
from typing import TypeVar, final

from drivers import clock
from drivers.backend import Backend
from drivers.errors import FrameError, LinkError, LinkTimeout
from drivers.link.refusals import PROTOCOL_VIOLATION, is_busy, refusal
from drivers.link.turns import SUPERSEDED, Preempted, RequestPriority, Turns
from drivers.protocol.definition import PROTOCOL
from drivers.protocol.messages import (
    Achieved,
    AmplifierEvent,
    Broadcast,
    Capabilities,
    FaultList,
    Identity,
    Loaded,
    Nak,
    Reply,
    Request,
    Status,
)
from drivers.statistics import LinkStatistics

REPLY_TIMEOUT = 0.030  # s; a heartbeat and three of these are less than three heartbeats of 50 ms
RETRIES = 2
ASSUME_ENERGISED = (
    ". Assume that the amplifier is energised until its watchdog has passed; opened again, it is "
    "disarmed"
)
"""End of every message of a loss."""

BUSY_PAUSE = 0.005  # s; before a retry to a busy amplifier; short against the latency of touch

_ReplyT = TypeVar("_ReplyT", Identity, Capabilities, Status, Achieved, FaultList, Loaded)


def retries_on(round_trip: float, *, reply_timeout: float = REPLY_TIMEOUT) -> int:
    """Return the number of retries on a wire whose longest exchange takes round_trip [s].

    One less than usual if that and the amplifier's own delay exceed the timeout [s].
    """
    is_slow = round_trip + PROTOCOL.reaction > reply_timeout
    return RETRIES - 1 if is_slow else RETRIES


@final
class Link:
    """Serialises requests to one backend: priorities, retries, loss detection, statistics.

    reply_timeout [s]: of one exchange, extended on slow wires. Three requests in a row without a
    reply are a loss; two on a wire too slow for three within three heartbeats, see `allow_for`.
    on_event: called, in the event loop, with unsolicited events.
    """

    def __init__(
        self, backend: Backend, *, reply_timeout: float, on_event: Callable[[AmplifierEvent], None]
    ) -> None:
        self.backend = backend
        self._reply_timeout = reply_timeout
        self._retries_allowed = RETRIES
        self._turns = Turns(lambda: backend.is_unsent)
        self._loss: str | None = "the amplifier is not open yet; call open() first"
        self._unanswered = 0
        self._is_aborting_unsent = False  # callers cancel soon
        self._is_persistently_busy = (
            False  # busy after all retries: none until it replies otherwise
        )
        self._retries = self._timeouts = self._refusals = 0
        self._last_round_trip: float | None = None
        self._last_heartbeat: float | None = None
        backend.listen(on_event, self._on_idle_loss)

    @property
    def is_lost(self) -> bool:
        """Whether every further request raises LinkError."""
        return self._loss is not None

    @property
    def statistics(self) -> LinkStatistics:
        """Link statistics; counted since opening or construction, see `LinkStatistics`."""
        beat = self._last_heartbeat
        return LinkStatistics(
            **asdict(self.backend.counters),
            retries=self._retries,
            timeouts=self._timeouts,
            refusals=self._refusals,
            last_round_trip=self._last_round_trip,
            heartbeat_age=None if beat is None else clock.now() - beat,
        )

    async def open(self) -> None:
        """Open the wire; raises LinkError."""
        await self.backend.open()
        self._loss = None
        self._unanswered = 0

    async def close(self) -> None:
        """Close the wire."""
        if self._loss is None:
            self._loss = "the amplifier was closed; open a new one"
        await self.backend.close()

    def allow_for(self, round_trip: float) -> None:
        """Retry once less if the longest exchange on the wire [s] exceeds the timeout."""
        self._retries_allowed = retries_on(round_trip, reply_timeout=self._reply_timeout)

    def heartbeat_acknowledged(self) -> None:
        """Note the reply to a heartbeat."""
        self._last_heartbeat = clock.now()

    async def ask(
        self,
        request: Request,
        *,
        expect: type[_ReplyT],
        priority: RequestPriority = RequestPriority.ORDINARY,
        timeout: float | None = None,
    ) -> _ReplyT:
        """Send a request by its priority and return its reply; timeout [s]: None for the default.

        Raises LinkError, CommandRefused for a refusal or if superseded, and FrameError for an
        invalid reply or one of another type.
        """
        self._raise_if_lost()
        timeout = timeout or self._reply_timeout
        name = type(request).__name__
        silencing = self.backend.silencing(request) if priority.is_stop_class else nullcontext()
        try:
            with silencing:
                reply = await self._retry_if_preempted(request, priority, timeout)
        except FrameError as problem:
            raise FrameError(
                f"invalid reply to {name}: {problem}; {PROTOCOL_VIOLATION}"
            ) from problem
        if isinstance(reply, Nak):
            self._refusals += 1
            raise refusal(name, reply)
        if not isinstance(reply, expect):
            raise FrameError(
                f"reply to {name} must be {expect.__name__}, got {type(reply).__name__}; "
                f"{PROTOCOL_VIOLATION}"
            )
        return reply

    def abort_unsent(self) -> None:
        """Do not send unsent requests, and retry none: they raise Preempted.

        Requests of the stop class are exempt.
        """
        self._is_aborting_unsent = True
        self._turns.preempt_unsent()

    async def broadcast(self, request: Broadcast, priority: RequestPriority) -> None:
        """Broadcast by its priority; raises LinkError, CommandError."""
        self._raise_if_lost()
        async with self._turns.take(priority):
            await self.backend.broadcast(request)

    async def _retry_if_preempted(
        self, request: Request, priority: RequestPriority, timeout: float
    ) -> Reply:
        while True:
            try:
                async with self._turns.take(priority):
                    self._raise_if_lost()
                    return await self._exchange(request, priority, timeout)
            except Preempted:
                if not priority.is_stop_class:  # stop-class requests are retried
                    raise

    async def _exchange(self, request: Request, priority: RequestPriority, timeout: float) -> Reply:
        busy = 0
        self._is_aborting_unsent = False
        while True:
            begin = clock.now()
            try:
                reply = await self.backend.exchange(request, timeout=timeout)
            except LinkTimeout as problem:
                self._timeouts += 1
                # Counted across requests: superseded ones must not hide a lost link.
                self._unanswered += 1
                if self._unanswered > self._retries_allowed:
                    what = f"{problem} (no reply to {self._unanswered} requests in a row)"
                    raise LinkTimeout(self._lose(what)) from problem
            except LinkError as problem:
                raise LinkError(self._lose(str(problem))) from problem
            else:
                self._unanswered = 0
                self._last_round_trip = clock.now() - begin
                if not is_busy(reply):
                    self._is_persistently_busy = False
                    return reply
                if self._is_persistently_busy or busy == RETRIES:
                    self._is_persistently_busy = True
                    return reply
                busy += 1
                await asyncio.sleep(BUSY_PAUSE)
            self._turns.raise_if_overtaken(priority)
            if self._is_aborting_unsent and not priority.is_stop_class:
                raise Preempted(SUPERSEDED)
            self._retries += 1

    def _on_idle_loss(self, what: str) -> None:
        """Note a loss found without a request."""
        if self._loss is None:
            self._lose(what)

    def _lose(self, what: str) -> str:
        self._loss = f"{what}{ASSUME_ENERGISED}"
        return self._loss

    def _raise_if_lost(self) -> None:
        if self._loss is not None:
            raise LinkError(self._loss)
