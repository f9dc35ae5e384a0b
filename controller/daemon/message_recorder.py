"""A ring buffer of the last messages of all lines, for fault dumps."""

import logging
from collections import deque
from collections.abc import Mapping
from typing import NamedTuple

from drivers import clock
from drivers.host.amplifier import Amplifier
from drivers.host.line import Line
from drivers.host.wire import Arrival, Broken, Event, Nak, Reply, Wire
from drivers.protocol.records import Values

MAX_RECORDS = 400  # over all lines: the last seconds under load, ten seconds at rest

_logger = logging.getLogger(__name__)


class MessageRecord(NamedTuple):
    """One message: time [s], amplifier or line, direction, name of the message, and its content."""

    time: float
    link: str
    direction: str
    message: str
    content: object = ""


class MessageRecorder:
    """Keeps the last messages unformatted."""

    def __init__(self) -> None:
        self._records: deque[MessageRecord] = deque(maxlen=MAX_RECORDS)

    def add(self, link: str, direction: str, message: str, content: object = "") -> None:
        """Add a message, replacing the oldest if full."""
        self._records.append(MessageRecord(clock.now(), link, direction, message, content))

    def records(self) -> list[MessageRecord]:
        """All records, oldest first."""
        return list(self._records)

    def follow(self, amplifiers: Mapping[str, Amplifier]) -> None:
        """Record the messages of the lines of amplifiers, by name, from now on."""
        by_line: dict[Line, dict[int, str]] = {}
        for name, amplifier in amplifiers.items():
            by_line.setdefault(amplifier.line, {})[amplifier.address] = name
            self.add(name, "open", "")
        for line, names in by_line.items():
            line.wire = RecordedWire(line.wire, line.name, names, self)


class RecordedWire:
    """A wire whose messages are recorded; names: of its amplifiers by address."""

    def __init__(
        self, inner: Wire, line: str, names: Mapping[int, str], recorder: MessageRecorder
    ) -> None:
        self.counters, self.delay, self.is_kept = inner.counters, inner.delay, inner.is_kept
        self.takes, self.busy = inner.takes, inner.busy
        self._inner = inner
        self._line = line
        self._names = names
        self._add = recorder.add
        self._peer = line

    def request(self, address: int, name: str, values: Values) -> bytes:
        """Return the bytes of a request; see `Wire`."""
        self._peer = self._names.get(address, self._line)
        self._record(self._peer, "out", name, values)
        data = self._inner.request(address, name, values)
        self.takes, self.busy = self._inner.takes, self._inner.busy
        return data

    def received(self, data: bytes) -> list[Arrival]:
        """Return what these bytes complete; see `Wire`."""
        arrivals = self._inner.received(data)
        self.takes, self.busy = self._inner.takes, self._inner.busy
        for arrival in arrivals:
            name = type(arrival).__name__
            match arrival:
                case Reply(values):
                    self._record(self._peer, "in", name, values)
                case Nak(code, channel):
                    self._record(self._peer, "in", name, {"code": code, "channel": channel})
                case Broken(reason):
                    self._record(self._peer, "in", name, reason)
                case Event(address, values):
                    self._record(self._names.get(address, self._line), "event", name, values)
        return arrivals

    def withdraw(self) -> None:
        """Take the request off the wire; see `Wire`."""
        self._record(self._peer, "none", "no reply")
        self._inner.withdraw()

    def transit(self, words: int) -> float:
        """See `Wire.transit`."""
        return self._inner.transit(words)

    def exchange_time(self, words: int, reply: int) -> float:
        """See `Wire.exchange_time`."""
        return self._inner.exchange_time(words, reply)

    def _record(self, link: str, direction: str, message: str, content: object = "") -> None:
        """Record a message; a stop depends on no record."""
        try:
            self._add(link, direction, message, content)
        except Exception:
            _logger.exception("recorder failed")
