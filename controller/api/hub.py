"""Notifications of the API: subscriptions to topics, and when each topic is sent.

`TOPICS` (`controller/api/methods.py`) defines how often each topic is sent.
"""

import asyncio
import logging
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence

from controller.api.jsonrpc import event_line
from controller.api.methods import TOPICS
from controller.api.schema import MAX_RATE, ApiMessage, Topic
from controller.api.server import Connection

DEFAULT_RATE = 10.0  # Hz; of periodic notifications

_logger = logging.getLogger(__name__)


class Hub:
    """Sends notifications to subscribers.

    current: returns the current data of a topic, or None.
    """

    def __init__(
        self,
        current: Mapping[Topic, Callable[[], ApiMessage | None]],
        *,
        clock: Callable[[], float],
    ) -> None:
        self._current = current
        self._clock = clock
        self.subscriptions: dict[Connection, dict[Topic, asyncio.TimerHandle | None]] = {}
        """Topics of each client, ordered by first subscription; with timers of periodic topics."""
        self._newest: dict[Topic, Callable[[], ApiMessage | None]] = {}
        self._flush: asyncio.TimerHandle | None = None
        self._flushed_at = -1.0
        self._failing: set[Topic] = set()
        self.lost = Counter[str]()
        """Number of notifications dropped because clients read too slowly, by topic."""

    def subscribe(
        self, connection: Connection, topics: Iterable[Topic], *, rate: float | None = None
    ) -> None:
        """Add topics, and send their current data; rate [Hz]: rate of periodic topics."""
        new = sorted(set(topics))
        self.unsubscribe(connection, new)
        self.subscriptions.setdefault(connection, {}).update(dict.fromkeys(new))
        for topic in new:
            if topic in self._current:
                self._send([connection], topic, self._current[topic])
            if TOPICS[topic].sent == "periodically":
                self._start_timer(connection, topic, 1 / (rate or DEFAULT_RATE))

    def unsubscribe(self, connection: Connection, topics: Iterable[Topic]) -> None:
        """Remove topics."""
        subscribed = self.subscriptions.get(connection, {})
        for topic in topics:
            timer = subscribed.pop(topic, None)
            if timer is not None:
                timer.cancel()

    def forget(self, connection: Connection) -> None:
        """Remove a client that has disconnected."""
        self.unsubscribe(connection, [*self.subscriptions.get(connection, {})])
        self.subscriptions.pop(connection, None)

    def publish(self, topic: Topic, make_data: Callable[[], ApiMessage | None]) -> None:
        """Send to all subscribers; make_data is called only if there are any.

        Nothing is sent if it returns None, for outdated data.
        """
        if TOPICS[topic].sent != "newest":
            self._send(self._subscribers_of(topic), topic, make_data)
            return
        if not self.subscriptions:
            return
        self._newest.pop(topic, None)  # sent in order of the newest change
        self._newest[topic] = make_data
        if self._flush is None:
            delay = max(0.0, self._flushed_at + 1 / MAX_RATE - self._clock())
            self._flush = asyncio.get_running_loop().call_later(delay, self._flush_now)

    def close(self) -> None:
        """Remove all clients."""
        for connection in list(self.subscriptions):
            self.forget(connection)
        if self._flush is not None:
            self._flush.cancel()

    def _flush_now(self) -> None:
        self._flush = None
        self._flushed_at = self._clock()
        newest = self._newest
        self._newest = {}
        for topic, make_data in newest.items():
            self._send(self._subscribers_of(topic), topic, make_data)

    def _subscribers_of(self, topic: Topic) -> list[Connection]:
        return [client for client, topics in self.subscriptions.items() if topic in topics]

    def _send(
        self,
        subscribers: Sequence[Connection],
        topic: Topic,
        make_data: Callable[[], ApiMessage | None],
    ) -> None:
        if not subscribers:
            return
        try:
            message = make_data()
            data = b"" if message is None else message.model_dump_json().encode()
        except Exception:  # the next change is still sent
            if topic not in self._failing:  # log once; marked, because the log is also a topic
                _logger.exception("topic %s: no data made", topic, extra={"topic": topic})
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
        self.subscriptions[connection][topic] = loop.call_later(period, send)
