"""What one amplifier was sent and has replied: its ledger, watchdog, latch and contradictions."""

import logging
import math
from collections.abc import Callable
from dataclasses import dataclass, replace

from drivers.errors import CommandError, CommandRefused, LinkDegraded, LinkError, Preempted
from drivers.host.comparison import MAX_CONTRADICTIONS, name_of, problem_of
from drivers.host.feeding import Feeding
from drivers.host.ledger import Ledger
from drivers.host.line import Line
from drivers.host.timing import FAST, SET_WORDS, STOP_RAMP, TAKEN_WORDS
from drivers.host.wire import WIDEST, Event, OtherHost, Several, reply_words, request_words
from drivers.protocol.records import Values
from drivers.protocol.sets import LayerSet, is_newer_token
from drivers.protocol.table import ENABLED, FAULTS, MESSAGES, QUANTITIES
from drivers.statistics import LinkStatistics

_SAME_MOMENT = 0.01  # s; statuses that are closer show a contradiction once
_RAMP, _WATCHDOG = QUANTITIES["ramp"], QUANTITIES["watchdog"]
_STATUS = MESSAGES["GetStatus"].reply
_SILENCING = ("Stop", "Disarm", "Silence")
_CHANGING = ("Arm", "Disarm", "Stop", "Clear")
_EVENT_WORDS = 11  # of a frame of its own, which precedes the reply to what changes the state
_logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Staged:
    """A set that an amplifier has staged, or plays at once: as the wire has it.

    is_exact: to the word; until: when [s] it must have been committed.
    """

    token: int
    layers: tuple[LayerSet, ...]
    is_exact: bool
    until: float


class Dialogue:
    """The exchanges with one amplifier, whose line is open; as it sees it."""

    def __init__(self, line: Line, address: int, name: str) -> None:
        self.line, self.address, self.name = line, address, name
        self.capabilities: Values = {}
        self.session = 0
        self.may_be_armed = False
        """Whether an Arm of this host may have been carried out since it was disarmed."""
        self.latch: int | None = None
        """Newest latch that a status has shown since it was identified."""
        self.status: Values | None = None
        """The last one."""
        self.status_at: float | None = None
        """When [s] it was read."""
        self.played_at = -math.inf
        """When [s] a set or silence was sent last."""
        self.committed = 0
        """Token of the set that it committed last, 0 for none since it was armed."""
        self.feeding = Feeding(line.wire.delay, line.wire.is_kept)
        self.counts = LinkStatistics()
        self.silence_cause: str | None = None
        """Why it is degraded: it did not reply to a request, and may still play."""
        self.listeners: list[Callable[[Values], None]] = []
        self.silences = 0
        """Stops and disarms that were sent to it."""
        self._times: dict[str, float] = {}  # of exchanges, by the name of the request
        self._time = line.time
        self._ledger: Ledger | None = None
        self._admitted: Staged | None = None
        self._contradictions = 0
        self._contradicted_at = -math.inf
        self._was_unfed = False  # the status of the last contradiction
        self._misachieved = 0  # sets in a row that were achieved as another
        self._other_host_at = -math.inf  # when it was heard last
        self._are_several = False  # two amplifiers have replied since this was reset
        line.members[address] = self

    @property
    def ledger(self) -> Ledger:
        """Its ledger, known once it is identified."""
        if self._ledger is None:
            raise CommandError(f"amplifier {self.name} must be opened first")
        return self._ledger

    def wire_ramp(self, ramp: float) -> int:
        """Return the nearest ramp that the amplifier has: silence is never refused for it."""
        highest = self.capabilities.get("ramp_max", _RAMP.maximum)
        if math.isnan(ramp):
            return _RAMP.to_wire(STOP_RAMP)
        return min(_RAMP.to_wire(min(max(ramp, 0.0), _RAMP.high)), int(highest))

    def is_silent(self, status: Values) -> bool:
        """Whether a status has the levels of all channels, and all are zero."""
        known = self.capabilities.get("channels")
        return known == len(status["levels"]) and not any(status["levels"])

    def exchange_time(self, name: str) -> float:
        """Return how long the longest request of a name and its reply take on the wire [s]."""
        if name not in self._times:
            can = self.capabilities
            size = (can["channels"], can["layers"]) if can else WIDEST
            event = _EVENT_WORDS if name in _CHANGING else 0
            words = request_words(name), reply_words(name, *size) + event
            self._times[name] = self.line.wire.exchange_time(*words)
        return self._times[name]

    @property
    def statistics(self) -> LinkStatistics:
        """Counts of its requests, and of all frames on its line."""
        return replace(self.counts, **vars(self.line.wire.counters))

    def note_sent(self, name: str, values: Values, now: float, arrives: float) -> None:
        """Note a request that is sent now and may reach it, at a time [s] unless it is delayed."""
        if name == "Hello":
            return
        if MESSAGES[name].feeds and (name == "Arm" or values["session"] == self.session):
            if name == "Silence" and self.silence_cause is not None:
                self.feeding.unheard(_RAMP.from_wire(values["ramp"]), now)
            else:
                self.feeding.sent(now, arrives)
        elif name in ("Stop", "Disarm"):
            self.feeding.fades(_RAMP.from_wire(values["ramp"]))
            self.silences += 1
        if name == "Arm":
            self.may_be_armed = True
        admitted = self._admitted
        if name in _SILENCING or name == "Arm":
            self._admitted = None
            if name == "Silence":
                self.played_at = now
        elif admitted is not None and values.get("token") == admitted.token and self._ledger:
            is_last = name == "Set" and values["now"] and values["index"] == values["parts"] - 1
            if name == "Commit" or is_last:
                self.played_at = now
                self._ledger.sent(admitted.token, admitted.layers, now)

    def note_reply(self, name: str, values: Values, reply: Values, sent_at: float) -> None:
        """Note the reply to a request that was sent at a time [s].

        Raises CommandRefused once its statuses contradict what was sent, twice in a row.
        """
        now = self._time()
        self.silence_cause = None
        self.counts.last_round_trip = now - sent_at
        message = MESSAGES.get(name)
        if message is None:
            return
        if message.feeds:
            self.feeding.confirmed(sent_at, now)
        if message.reply is _STATUS:
            self._note_status(name, values, reply, sent_at, now)
        elif name == "Set" and reply["played"]:
            self._confirm(values["token"], now)

    def note_unasked(self, arrival: Event | OtherHost | Several) -> None:
        """Note what came without a request; an event is handed on.

        Another host must feed the watchdog within its longest time.
        """
        if isinstance(arrival, OtherHost):
            self._other_host_at = self._time()
        elif isinstance(arrival, Several):
            self._are_several = True
        else:
            for listener in self.listeners:
                try:
                    listener(arrival.values)
                except Exception:
                    _logger.exception("amplifier %s: a listener failed", self.name)

    def check_other_host(self) -> None:
        """Raise LinkError if another host drives it."""
        if self._time() - self._other_host_at <= _WATCHDOG.high:
            raise self._driven_by_another()

    def next_request(self, name: str, values: Values) -> float:
        """Return how much later than on a fast wire the reply to a request may come [s].

        Raises for what plays or feeds, while it must not go out: LinkError while degraded or beside
        another host, CommandRefused once a status has shown that it is not armed any more.
        """
        takes = self._times[name] if name in self._times else self.exchange_time(name)
        if name == "Set" and takes > FAST:  # much shorter, nearly always
            words = SET_WORDS + len(values["stream"])
            takes = self.line.wire.exchange_time(words, TAKEN_WORDS)
        longer = takes - FAST if takes > FAST else 0.0
        if name in ("Hello", "Silence") or not MESSAGES[name].feeds:
            return longer
        if self._other_host_at > -math.inf:
            self.check_other_host()
        if self.silence_cause is not None:
            raise LinkDegraded(
                f"{self.silence_cause}. The amplifier may play its last set until its watchdog has "
                "passed; nothing new is played until it replies"
            )
        if name != "Arm" and self.status is not None and self.status["state"] != ENABLED:
            raise self.disarmed(self.status)
        return longer

    def while_admitted(self, token: int, values: Values) -> Values:
        """Return the values of a request of a set; raises DriverError unless it may play now."""
        admitted = self._admitted
        if admitted is None or admitted.token != token:
            raise Preempted(f"amplifier {self.name}: a stop, disarm or newer set came first")
        if (now := self._time()) > admitted.until:
            raise CommandRefused(
                f"amplifier {self.name}: set {token} must be committed {now - admitted.until:.3g} "
                "s earlier; the wire is too slow or too busy"
            )
        return values

    def _confirm(self, token: int, now: float) -> None:
        """Note that the amplifier plays the set with this token, as it says."""
        self.committed = token
        if self._ledger is not None:
            self._ledger.resolve(token, now)
        if self._admitted is not None and self._admitted.token == token:
            self._admitted = None

    def _note_status(
        self, name: str, values: Values, status: Values, sent_at: float, now: float
    ) -> None:
        """Note a status; raises CommandRefused once it contradicts what was sent twice."""
        if (latch := status["latch"]) != self.latch and (
            self.latch is None or is_newer_token(latch, self.latch)
        ):
            self.latch = latch
        self.status, self.status_at = status, now
        if self._ledger is None:
            return
        if name in _SILENCING:
            self._ledger.silenced(_RAMP.from_wire(values["ramp"]), sent_at, now)
            return
        self._confirm(status["token"], now)
        if not self.session or name in ("Arm", "Clear") or status["state"] != ENABLED:
            return
        fed = MESSAGES[name].feeds
        problem = problem_of(status, self._ledger, self.feeding, sent_at=sent_at, now=now, fed=fed)
        if problem is None:
            # A status after a request that feeds says nothing of how the watchdog runs down.
            if not (fed and self._was_unfed):
                self._contradictions, self._contradicted_at = 0, -math.inf
        else:
            self._was_unfed = not fed
            self.note_contradiction(problem, now)

    def note_contradiction(self, problem: str, now: float) -> None:
        """Count a contradiction at a time [s]; raises CommandRefused for the second in a row."""
        if now - self._contradicted_at < _SAME_MOMENT:
            return
        self._contradictions, self._contradicted_at = self._contradictions + 1, now
        if self._contradictions >= MAX_CONTRADICTIONS:
            raise self.contradicted(problem)

    def contradicted(self, problem: str) -> CommandRefused:
        """Return the error of contradictions in a row."""
        return CommandRefused(
            f"amplifier {self.name} contradicts its requests: {problem}; look for a derated or "
            "broken channel, an exchanged cable or firmware, then clear and arm again"
        )

    def disarmed(self, status: Values) -> CommandRefused:
        """Return the error of what plays or feeds, once a status shows that it is not armed."""
        return CommandRefused(
            f"amplifier {self.name} is no longer armed, fault {name_of(FAULTS, status['fault'])}; "
            "once the cause is gone, clear and arm again",
            is_disarmed=True,
        )

    def _driven_by_another(self) -> LinkError:
        return LinkError(f"amplifier {self.name} is driven by another host; end that one first")
