"""The topics of `event` notifications, the data of each, and subscriptions to them.

`TOPICS` says how often each topic is sent.
"""

import asyncio
import logging
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Literal, NamedTuple

from pydantic import Field

from controller.api.amplifier_status import AmplifierStatus
from controller.api.connection import Connection
from controller.api.jsonrpc import event_line
from controller.api.methods import StrengthResult
from controller.api.schema import (
    MAX_RATE,
    STATE_WORDS,
    CauseAndRemedy,
    ContactStatus,
    Count,
    DaemonStateName,
    Epoch,
    LatencySummary,
    Message,
    PatternFields,
    PlateEvent,
    Topic,
    TouchInputStatus,
)


class StateEvent(CauseAndRemedy):
    """The daemon changed its state."""

    old: DaemonStateName
    new: DaemonStateName
    word: str = Field(
        default_factory=lambda known: STATE_WORDS[known["new"]],
        description="the new state in a word for people",
    )
    epoch: Epoch


class ContactsEvent(Message):
    """All contacts after a change, before a pattern is selected for them."""

    contacts: list[ContactStatus]


class PatternEvent(PatternFields):
    """A pattern that the amplifiers confirmed."""

    latency_ms: float | None = Field(
        description="from the touch to the last byte of the command; null if none was needed"
    )


class SilenceEvent(Message):
    """No channel is driven; if a link is lost (see the state), as far as known."""

    contacts: list[ContactStatus]
    reason: str
    latency_ms: float | None = Field(description="null if no command was needed")


class AmplifiersEvent(Message):
    """All amplifiers, at the subscribed rate."""

    amplifiers: list[AmplifierStatus]


class LatencyEvent(Message):
    """Latencies, at the subscribed rate."""

    latency_ms: LatencySummary


class LogEvent(Message):
    """A record of the daemon's log."""

    level: Literal["info", "warning", "error"]
    message: str
    cause: str | None
    remedy: str | None


class LinkEvent(Message):
    """The link to amplifiers was lost, could not be reopened, or was reopened.

    Degraded: an amplifier does not reply but may still play; nothing new is played until it replies
    (restored) or is lost.
    """

    event: Literal["degraded", "restored", "lost", "retry", "reopened"]
    amplifier: str | None = Field(description="its name, if known")
    message: str
    remedy: str | None


class LayoutEvent(Message):
    """Another surface layout is in use, or it was replaced; `effects` may have changed with it."""

    name: str | None = Field(None, description="of the layout in use; null without one")
    layout: dict[str, Any] | None = Field(description="the surface layout; null without one")


class InputsEvent(Message):
    """A touch input was opened, fell silent or was lost, or touches were rejected."""

    inputs: list[TouchInputStatus] = Field(description="all of the configuration")
    rejected_touches: dict[str, Count] = Field(description="number by reason, of all sources")


class TopicData(NamedTuple):
    """A topic: its data, its summary, and when it is sent.

    At every change; or the newest of several changes, at most 60 times per second; or at the rate
    that a client has subscribed with.
    """

    data: type[Message]
    summary: str
    sent: Literal["always", "newest", "periodically"] = "always"


TOPICS: dict[Topic, TopicData] = {
    "state": TopicData(StateEvent, "every change of state or epoch, with its cause"),
    "contacts": TopicData(ContactsEvent, "fingers touched, moved or lifted", "newest"),
    "pattern": TopicData(PatternEvent, "what plays now, as the amplifiers confirmed it", "newest"),
    "silence": TopicData(SilenceEvent, "nothing plays now, and why", "newest"),
    "amplifiers": TopicData(
        AmplifiersEvent, "status of the amplifiers, at rate_hz", "periodically"
    ),
    "latency": TopicData(LatencyEvent, "latency from touch to command, at rate_hz", "periodically"),
    "log": TopicData(LogEvent, "log records from level info, without those of `state` and `link`"),
    "link": TopicData(LinkEvent, "links to amplifiers that were degraded, lost or reopened"),
    "layout": TopicData(LayoutEvent, "another surface layout is in use, or it was replaced"),
    "plate": TopicData(PlateEvent, "the plate has changed, or is followed otherwise"),
    "inputs": TopicData(
        InputsEvent, "touch inputs that are missing, mute or back; rejected touches, each second"
    ),
    "strength": TopicData(
        StrengthResult, "strengths of sources, clients and regions, at rate_hz", "periodically"
    ),
}
"""Every topic, by name."""


class EventParams(Message):
    """Parameters of an `event` notification."""

    topic: Topic
    time_s: float = Field(description="on CLOCK_MONOTONIC")
    lost: Count = Field(
        description="notifications dropped before this one because the client reads too slowly"
    )
    data: dict[str, object]


DEFAULT_RATE = 10.0  # Hz

_logger = logging.getLogger(__name__)


class Hub:
    """Sends notifications to subscribers; current: a topic's present data, None if it has none."""

    def __init__(
        self,
        current: Mapping[Topic, Callable[[], Message | None]],
        *,
        clock: Callable[[], float],
    ) -> None:
        self._current = current
        self._clock = clock
        self._subscribers: dict[Connection, None] = {}  # in the order of their first subscription
        self._newest: dict[Topic, Callable[[], Message | None]] = {}
        self._flush: asyncio.TimerHandle | None = None
        self._flushed_at = -1.0
        self._failing: set[Topic] = set()
        self.lost = Counter[str]()
        """Notifications that were dropped, as their clients read too slowly, by topic."""

    def subscribe(
        self, connection: Connection, topics: Iterable[Topic], *, rate: float | None = None
    ) -> None:
        """Add topics, and send their current data; rate [Hz]: of those that are periodic."""
        new = sorted(set(topics))
        self.unsubscribe(connection, new)
        self._subscribers[connection] = None
        connection.topics.update(dict.fromkeys(new))
        for topic in new:
            if topic in self._current:
                self._send([connection], topic, self._current[topic])
            if TOPICS[topic].sent == "periodically":
                self._start_timer(connection, topic, 1 / (rate or DEFAULT_RATE))

    def unsubscribe(self, connection: Connection, topics: Iterable[Topic]) -> None:
        """Remove topics."""
        for topic in topics:
            timer = connection.topics.pop(topic, None)
            if timer is not None:
                timer.cancel()

    def forget(self, connection: Connection) -> None:
        """Remove a client that has disconnected."""
        self.unsubscribe(connection, [*connection.topics])
        self._subscribers.pop(connection, None)

    def publish(self, topic: Topic, make_data: Callable[[], Message | None]) -> None:
        """Send to all subscribers; make_data is called only if there are any.

        Nothing is sent if it returns None, for outdated data.
        """
        if TOPICS[topic].sent != "newest":
            self._send(self._of(topic), topic, make_data)
            return
        if not self._subscribers:
            return
        self._newest.pop(topic, None)  # sent in the order of the newest
        self._newest[topic] = make_data
        if self._flush is None:
            delay = max(0.0, self._flushed_at + 1 / MAX_RATE - self._clock())
            self._flush = asyncio.get_running_loop().call_later(delay, self._flush_now)

    def close(self) -> None:
        """Remove all clients."""
        for connection in list(self._subscribers):
            self.forget(connection)
        if self._flush is not None:
            self._flush.cancel()

    def _flush_now(self) -> None:
        self._flush = None
        self._flushed_at = self._clock()
        newest, self._newest = self._newest, {}
        for topic, make_data in newest.items():
            self._send(self._of(topic), topic, make_data)

    def _of(self, topic: Topic) -> list[Connection]:
        return [each for each in self._subscribers if topic in each.topics]

    def _send(
        self,
        subscribers: Sequence[Connection],
        topic: Topic,
        make_data: Callable[[], Message | None],
    ) -> None:
        if not subscribers:
            return
        try:
            message = make_data()
            data = b"" if message is None else message.model_dump_json().encode()
        except Exception:  # the next change is sent all the same
            if topic not in self._failing:  # once; marked, as the log is a topic too
                _logger.exception("topic %s: data not made", topic, extra={"topic": topic})
            self._failing.add(topic)
            return
        self._failing.discard(topic)
        if message is None:
            return
        now = self._clock()
        for connection in subscribers:
            self.lost[topic] += connection.notify(
                lambda lost: event_line(topic, time=now, lost=lost, data=data)
            )

    def _start_timer(self, connection: Connection, topic: Topic, period: float) -> None:
        """Send a topic every period [s]."""

        def send() -> None:
            self._send([connection], topic, self._current[topic])
            self._start_timer(connection, topic, period)

        loop = asyncio.get_running_loop()
        connection.topics[topic] = loop.call_later(period, send)
