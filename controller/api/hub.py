"""Who is told of what: subscriptions, and how often each is served.

Changes of `state`, `log` and `link` go out one by one. Of `contacts`, `pattern` and `silence` the
newest goes out, 60 times a second at most, for touches come faster than anybody looks. `amplifiers`
and `latency` are asked for at the rate each client wishes.
"""

import asyncio
from collections.abc import Callable, Iterable, Mapping, Sequence

from controller.api.connection import Connection
from controller.api.jsonrpc import event_line
from controller.api.schema import MAX_RATE, Message, Topic

DEFAULT_RATE = 10.0  # Hz
_COALESCED: frozenset[Topic] = frozenset({"contacts", "pattern", "silence"})
_PERIODIC: frozenset[Topic] = frozenset({"amplifiers", "latency"})


class Hub:
    """Tells clients what they have subscribed to; current: what is so now, None for nothing."""

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

    def subscribe(
        self, connection: Connection, topics: Iterable[Topic], *, rate: float | None = None
    ) -> None:
        """Tell a client of more topics, from what is so now on; rate [Hz] of what is periodic."""
        topics = set(topics)
        self._topics.setdefault(connection, set()).update(topics)
        for topic in sorted(topics & self._current.keys()):
            self._send([connection], topic, self._current[topic])
        if topics & _PERIODIC:
            self._cancel(connection)
            self._repeat(connection, 1 / (rate or DEFAULT_RATE))

    def unsubscribe(self, connection: Connection, topics: Iterable[Topic]) -> None:
        """Tell a client of these no more."""
        left = self._topics.get(connection, set())
        left.difference_update(topics)
        if not left & _PERIODIC:
            self._cancel(connection)
        if not left:
            self._topics.pop(connection, None)

    def forget(self, connection: Connection) -> None:
        """A client is gone."""
        self._cancel(connection)
        self._topics.pop(connection, None)

    def is_subscribed(self, connection: Connection) -> bool:
        """Whether a client has subscribed to anything."""
        return connection in self._topics

    def publish(self, topic: Topic, make: Callable[[], Message | None]) -> None:
        """Tell all who have subscribed; make is only called where there is somebody.

        What it makes None of is not told: it is over by then.
        """
        if topic not in _COALESCED:
            self._send(self._listeners(topic), topic, make)
            return
        if not self._topics:
            return
        self._newest.pop(topic, None)  # the order is that of the newest
        self._newest[topic] = make
        if self._flush is None:
            due = max(0.0, self._flushed_at + 1 / MAX_RATE - self._clock())
            self._flush = asyncio.get_running_loop().call_later(due, self._flush_now)

    def close(self) -> None:
        """Tell nobody any more."""
        for connection in list(self._topics):
            self.forget(connection)
        if self._flush is not None:
            self._flush.cancel()

    def _flush_now(self) -> None:
        self._flush = None
        self._flushed_at = self._clock()
        newest, self._newest = self._newest, {}
        for topic, make in newest.items():
            self._send(self._listeners(topic), topic, make)

    def _listeners(self, topic: Topic) -> list[Connection]:
        return [one for one, topics in self._topics.items() if topic in topics]

    def _send(
        self,
        listeners: Sequence[Connection],
        topic: Topic,
        make: Callable[[], Message | None],
    ) -> None:
        said = make() if listeners else None
        if said is None:
            return
        now, data = self._clock(), said.model_dump_json().encode()
        for connection in listeners:
            connection.notify(lambda lost: event_line(topic, time=now, lost=lost, data=data))

    def _repeat(self, connection: Connection, period: float) -> None:
        """Send what is periodic again and again, every period [s]."""

        def tell() -> None:
            for topic in sorted(self._topics.get(connection, set()) & _PERIODIC):
                self._send([connection], topic, self._current[topic])
            self._timers[connection] = loop.call_later(period, tell)

        loop = asyncio.get_running_loop()
        self._timers[connection] = loop.call_later(period, tell)

    def _cancel(self, connection: Connection) -> None:
        timer = self._timers.pop(connection, None)
        if timer is not None:
            timer.cancel()
