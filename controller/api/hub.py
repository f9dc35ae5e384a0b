"""Subscriptions to topics, and how often each topic is sent.

`state`, `log`, `link` and `layout` are sent at every change. Of `contacts`, `pattern` and `silence`
the newest is sent, at most 60 times per second. `amplifiers` and `latency` are sent at the rate
that each client subscribed with.
"""

import asyncio
import logging
from collections.abc import Callable, Iterable, Mapping, Sequence

from controller.api.connection import Connection
from controller.api.jsonrpc import event_line
from controller.api.schema import MAX_RATE, Message, Topic

DEFAULT_RATE = 10.0  # Hz
_COALESCED: frozenset[Topic] = frozenset({"contacts", "pattern", "silence"})
_PERIODIC: frozenset[Topic] = frozenset({"amplifiers", "latency"})

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
        self._topics: dict[Connection, set[Topic]] = {}
        self._timers: dict[Connection, asyncio.TimerHandle] = {}
        self._newest: dict[Topic, Callable[[], Message | None]] = {}
        self._flush: asyncio.TimerHandle | None = None
        self._flushed_at = -1.0
        self._failing: set[Topic] = set()

    def subscribe(
        self, connection: Connection, topics: Iterable[Topic], *, rate: float | None = None
    ) -> None:
        """Add topics, and send their current data; rate [Hz]: of the periodic ones."""
        topics = set(topics)
        self._topics.setdefault(connection, set()).update(topics)
        for topic in sorted(topics & self._current.keys()):
            self._send([connection], topic, self._current[topic])
        if topics & _PERIODIC:
            self._cancel_timer(connection)
            self._start_timer(connection, 1 / (rate or DEFAULT_RATE))

    def unsubscribe(self, connection: Connection, topics: Iterable[Topic]) -> None:
        """Remove topics."""
        remaining = self._topics.get(connection, set())
        remaining.difference_update(topics)
        if not remaining & _PERIODIC:
            self._cancel_timer(connection)
        if not remaining:
            self._topics.pop(connection, None)

    def forget(self, connection: Connection) -> None:
        """Remove a client that has disconnected."""
        self._cancel_timer(connection)
        self._topics.pop(connection, None)

    def is_subscribed(self, connection: Connection) -> bool:
        """Whether a client has subscribed to any topic."""
        return connection in self._topics

    def publish(self, topic: Topic, make_data: Callable[[], Message | None]) -> None:
        """Send to all subscribers; make_data is called only if there are any.

        Nothing is sent if it returns None, for outdated data.
        """
        if topic not in _COALESCED:
            self._send(self._subscribers(topic), topic, make_data)
            return
        if not self._topics:
            return
        self._newest.pop(topic, None)  # sent in the order of the newest
        self._newest[topic] = make_data
        if self._flush is None:
            delay = max(0.0, self._flushed_at + 1 / MAX_RATE - self._clock())
            self._flush = asyncio.get_running_loop().call_later(delay, self._flush_now)

    def close(self) -> None:
        """Remove all clients."""
        for connection in list(self._topics):
            self.forget(connection)
        if self._flush is not None:
            self._flush.cancel()

    def _flush_now(self) -> None:
        self._flush = None
        self._flushed_at = self._clock()
        newest, self._newest = self._newest, {}
        for topic, make_data in newest.items():
            self._send(self._subscribers(topic), topic, make_data)

    def _subscribers(self, topic: Topic) -> list[Connection]:
        return [connection for connection, topics in self._topics.items() if topic in topics]

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

    def _start_timer(self, connection: Connection, period: float) -> None:
        """Send the periodic topics every period [s]."""

        def send() -> None:
            for topic in sorted(self._topics.get(connection, set()) & _PERIODIC):
                self._send([connection], topic, self._current[topic])
            self._timers[connection] = loop.call_later(period, send)

        loop = asyncio.get_running_loop()
        self._timers[connection] = loop.call_later(period, send)

    def _cancel_timer(self, connection: Connection) -> None:
        timer = self._timers.pop(connection, None)
        if timer is not None:
            timer.cancel()
