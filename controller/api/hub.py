"""Subscriptions to topics; `TOPICS` says how often each topic is sent."""

import asyncio
import logging
from collections.abc import Callable, Iterable, Mapping, Sequence

from controller.api.connection import Connection
from controller.api.jsonrpc import event_line
from controller.api.schema import MAX_RATE, Message, Topic
from controller.api.topics import TOPICS

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
            connection.notify(lambda lost: event_line(topic, time=now, lost=lost, data=data))

    def _start_timer(self, connection: Connection, topic: Topic, period: float) -> None:
        """Send a topic every period [s]."""

        def send() -> None:
            self._send([connection], topic, self._current[topic])
            self._start_timer(connection, topic, period)

        loop = asyncio.get_running_loop()
        connection.topics[topic] = loop.call_later(period, send)
