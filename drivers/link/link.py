"""One request at a time over one backend, retried if there is no reply.

A lost link stays lost until it is reopened: every request raises LinkError at once.
"""

import contextlib
from collections.abc import Callable
from dataclasses import asdict
from typing import TypeVar, final

from drivers import clock
from drivers.backend import Backend
from drivers.errors import FrameError, LinkDegraded, LinkError, LinkTimeout
from drivers.line.priority import Priority, priority_of
from drivers.line.sender import Retry, Sender, sender_of
from drivers.link.refusals import PROTOCOL_VIOLATION, is_busy, refusal
from drivers.protocol.definition import PROTOCOL
from drivers.protocol.messages import (
    Achieved,
    AmplifierEvent,
    Apply,
    Broadcast,
    Capabilities,
    Disarm,
    FaultList,
    GetCaps,
    GetFaults,
    GetStatus,
    Hello,
    Identity,
    Loaded,
    Measured,
    Nak,
    Reading,
    Reply,
    Request,
    SampleBlock,
    SensorList,
    Status,
    Stop,
)
from drivers.statistics import LinkStatistics

REPLY_TIMEOUT = 0.030  # s; a heartbeat and three of these are less than three heartbeats of 50 ms
RETRIES = 2
ASSUME_ENERGISED = (
    ". Assume that the amplifier is energised until its watchdog has expired; opened again, it is "
    "disarmed"
)
"""End of every message of a loss."""

DEGRADED = (
    ". The amplifier may play its last set until its watchdog has passed; nothing new is played "
    "until it replies"
)
"""End of every message of a degraded link."""

BUSY_PAUSE = 0.005  # s; before a retry to a busy amplifier; short against the latency of touch

ReplyT = TypeVar(
    "ReplyT",
    Identity,
    Capabilities,
    Status,
    Achieved,
    FaultList,
    Loaded,
    Measured,
    SensorList,
    Reading,
    SampleBlock,
)


def retries_on(round_trip: float, *, reply_timeout: float = REPLY_TIMEOUT) -> int:
    """Return the number of retries on a wire whose longest exchange takes round_trip [s].

    One less than usual if that and the amplifier's own delay exceed the timeout [s].
    """
    is_slow = round_trip + PROTOCOL.reaction > reply_timeout
    return RETRIES - 1 if is_slow else RETRIES


def is_allowed_when_degraded(request: Request) -> bool:
    """Whether a request silences the amplifier or does not feed its watchdog."""
    if isinstance(request, Apply):
        return request.command_set.is_silent
    return isinstance(request, Stop | Disarm | GetStatus | GetFaults | Hello | GetCaps)


@final
class Link:
    """Serialises requests to one backend: priorities, retries, loss detection, statistics.

    reply_timeout [s]: of one exchange, extended on slow wires. Three requests in a row without a
    reply are a loss; two on a wire too slow for three within three heartbeats, see
    `allow_longest_exchange`. on_event: called, in the event loop, with unsolicited events;
    silent_from: returns the time [s] by which the amplifier's watchdog must have expired, minus
    infinity if it was never armed.

    Without a reply to several requests in a row the link is degraded while the amplifier may still
    play, and lost once it must be silent. On a degraded link only requests are sent that silence
    the amplifier or do not feed its watchdog; any reply restores it.
    """

    def __init__(
        self,
        backend: Backend,
        *,
        reply_timeout: float,
        on_event: Callable[[AmplifierEvent], None],
        silent_from: Callable[[], float],
    ) -> None:
        self.backend = backend
        self._silent_from = silent_from
        self._reply_timeout = reply_timeout
        self._retries_allowed = RETRIES
        self._sender = Sender()  # that of the line, once it is open
        self._loss: str | None = "the amplifier is not open yet; call open() first"
        self._is_open = False
        self._unanswered = 0  # requests without a reply since the last reply
        # Busy after all retries: none until it replies otherwise.
        self._is_persistently_busy = False
        self._retries = self._timeouts = self._refusals = 0
        self._last_round_trip: float | None = None
        backend.listen(on_event, self._on_idle_loss)

    @property
    def is_lost(self) -> bool:
        """Whether every further request but a Stop raises LinkError."""
        return self._loss is not None

    @property
    def is_degraded(self) -> bool:
        """Whether several requests in a row had no reply; the amplifier may still play."""
        return self._unanswered > self._retries_allowed and not self.is_lost

    @property
    def statistics(self) -> LinkStatistics:
        """Link statistics; counted since opening or construction, see `LinkStatistics`."""
        return LinkStatistics(
            **asdict(self.backend.counters),
            retries=self._retries,
            timeouts=self._timeouts,
            refusals=self._refusals,
            last_round_trip=self._last_round_trip,
        )

    async def open(self) -> None:
        """Open the wire; raises LinkError."""
        await self.backend.open()
        self._sender = sender_of(self.backend)
        self._loss = None
        self._is_open = True
        self._unanswered = 0

    async def close(self) -> None:
        """Close the wire."""
        self._is_open = False
        if self._loss is None:
            self._loss = "the amplifier was closed; open a new one"
        await self.backend.close()

    def allow_longest_exchange(self, round_trip: float) -> None:
        """Retry once less if the longest exchange on the wire [s] exceeds the timeout."""
        self._retries_allowed = retries_on(round_trip, reply_timeout=self._reply_timeout)

    async def request(
        self, request: Request, *, expect: type[ReplyT], timeout: float | None = None
    ) -> ReplyT:
        """Send a request by its priority and return its reply; timeout [s]: None for the default.

        Raises LinkError, CommandRefused for a refusal or if superseded, and FrameError for an
        invalid reply or one of another type. A Stop is sent on a lost link, too.
        """
        self._raise_if_unusable(request)
        name = type(request).__name__
        attempts = _Attempts(self, request, timeout or self._reply_timeout)
        try:
            reply = await self._sender.send(self.backend, priority_of(request), attempts.make_one)
        except FrameError as problem:
            raise FrameError(
                f"invalid reply to {name}: {problem}; {PROTOCOL_VIOLATION}"
            ) from problem
        if isinstance(reply, Nak):
            self._refusals += 1
            raise refusal(request, reply, may_play=attempts.unanswered_count > 0)
        if not isinstance(reply, expect):
            raise FrameError(
                f"reply to {name} must be {expect.__name__}, got {type(reply).__name__}; "
                f"{PROTOCOL_VIOLATION}"
            )
        return reply

    def abort_unsent(self) -> None:
        """Discard unsent requests and retry none: they raise Preempted.

        Stop-class requests are exempt.
        """
        self._sender.abort_unsent(self.backend)

    async def broadcast(self, request: Broadcast) -> None:
        """Broadcast by its priority; raises LinkError, CommandError.

        A Stop is broadcast during an exchange, too, if the wire can, and then again after it.
        """
        self._raise_if_unusable(request)
        if isinstance(request, Stop) and self._sender.is_in_use:
            with contextlib.suppress(LinkError):
                await self.backend.broadcast(request)
        await self._sender.send(
            self.backend, priority_of(request), lambda: self.backend.broadcast(request)
        )

    def _no_reply(self, problem: LinkTimeout) -> LinkTimeout | None:
        """Count a missing reply; returns the error after too many: degraded, or now lost."""
        self._timeouts += 1
        # Counted across requests: superseded ones must not hide a lost link.
        self._unanswered += 1
        if self._unanswered <= self._retries_allowed:
            return None
        cause = f"{problem} (no reply to {self._unanswered} requests in a row)"
        if self._loss is None and clock.now() < self._silent_from():
            return LinkDegraded(f"{cause}{DEGRADED}")
        return LinkTimeout(self._lose(cause))

    def _on_idle_loss(self, cause: str) -> None:
        """Note a loss found without a request."""
        if self._loss is None:
            self._lose(cause)

    def _lose(self, cause: str) -> str:
        self._loss = self._loss or f"{cause}{ASSUME_ENERGISED}"
        return self._loss

    def _raise_if_unusable(self, request: Request) -> None:
        """Raise LinkError if a request must not be sent on a lost or degraded link."""
        if self._loss is not None and not (self._is_open and isinstance(request, Stop)):
            raise LinkError(self._loss)
        if self.is_degraded and not is_allowed_when_degraded(request):
            raise LinkDegraded(f"no reply to {self._unanswered} requests in a row{DEGRADED}")


@final
class _Attempts:
    """The attempts of one request."""

    __slots__ = ("_busy", "_link", "_made", "_request", "_timeout", "unanswered_count")

    def __init__(self, link: Link, request: Request, timeout: float) -> None:
        self._link = link
        self._request = request
        self._timeout = timeout
        self._made = self._busy = self.unanswered_count = 0

    async def make_one(self) -> Reply:
        """Send the request and return its reply; raises `Retry` to repeat it."""
        link = self._link
        link._raise_if_unusable(self._request)  # it may have waited
        link._retries += self._made > 0
        self._made += 1
        begin = clock.now()
        try:
            reply = await link.backend.exchange(self._request, timeout=self._timeout)
        except LinkTimeout as problem:
            self.unanswered_count += 1
            if priority_of(self._request) is Priority.READING:  # its absence says nothing of others
                if self._made > link._retries_allowed:
                    raise
                raise Retry from problem
            error = link._no_reply(problem)
            is_last_stop = isinstance(self._request, Stop) and self._made > RETRIES
            if error is not None and (is_last_stop or not isinstance(self._request, Stop)):
                raise error from problem
            raise Retry from problem
        except LinkError as problem:
            raise LinkError(link._lose(str(problem))) from problem
        link._unanswered = 0
        link._last_round_trip = clock.now() - begin
        has_no_time = is_busy(reply)
        if has_no_time and not link._is_persistently_busy and self._busy < RETRIES:
            self._busy += 1
            raise Retry(BUSY_PAUSE)
        link._is_persistently_busy = has_no_time
        return reply
