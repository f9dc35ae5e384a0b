"""The state of an amplifier, derived from each request sent to it and each reply.

`AmplifierRecord` notes requests and replies for the line (`Member`), and passes them to the objects
that keep the state: `AmplifierIdentification`, `SetAdmission` (which set may be sent) with the
`Ledger`, `Feeding` (the watchdog), `HeldClock`, `StatusContradictions`, and `PlaybackBound`.
`check_may_send` decides whether a request may be sent. `what_may_play` decides until when the
amplifier may still play.
"""

import logging
import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache

from drivers.errors import CommandError, CommandRefused, LinkDegraded
from drivers.host.clock import HeldClock
from drivers.host.identification import AmplifierIdentification
from drivers.host.ledger import Ledger
from drivers.host.line import Line
from drivers.host.requests import LinkStatistics, Priority
from drivers.host.set_admission import SetAdmission, StagedSet
from drivers.host.statuses import (
    MAX_START_ERROR,
    REPORT_LIFE,
    REPORTS,
    ReportKind,
    StatusContradictions,
    reports_of,
)
from drivers.host.stops import PendingStop, PlaybackBound, StopOutcome
from drivers.host.watchdog import Feeding
from drivers.protocol.definition import (
    ENABLED,
    EVENT_RECORD,
    FAST,
    FAULTS,
    HIGH_TIME,
    QUANTITIES,
    REQUESTS,
    SET_WORDS,
    STATES,
    Message,
    name_of,
)
from drivers.protocol.records import Values
from drivers.protocol.sets import is_last, is_newer_token
from drivers.wires.wire import (
    WIDEST,
    DuplicateAddress,
    Event,
    OtherHost,
    reply_words,
    request_words,
)
from registry.limits import GuardLimits

_RAMP = QUANTITIES["ramp"]
_COMMIT = REQUESTS["Commit"]
_PING = REQUESTS["Ping"]
_EVENT_WORDS = EVENT_RECORD.words + 7
"""Words of an event, which may come before a reply in a frame of its own of 7 words."""
_SURELY = 3.0  # standard errors of a clock
COMMITTING = 0.1
"""Time [s] within which a commit arrives and is carried out."""
_logger = logging.getLogger(__name__)


class AmplifierRecord:
    """The state of an amplifier on an open line.

    limits: configured limits. serial_number: expected serial number; None for any. is_output: the
    meaning of full level in the rig: True for the output of a linear amplifier, False for the
    motion of a stiff source, None for either.
    """

    identification: AmplifierIdentification
    """Its identity and capabilities."""
    exchange_time: Callable[[str], float]
    """Return how long the longest request with a name and its reply take on the wire [s]."""
    counts: LinkStatistics
    """Counts of the requests to it."""
    listeners: list[Callable[[Values], None]]
    """They are called with the values of each event."""

    # Status
    status: Values | None = None
    """The last status."""
    status_at: float | None = None
    """When the last status came [s]."""
    latch: int | None = None
    """Newest latch that a status has shown since it was identified."""
    reported_at: dict[ReportKind, float]
    """When a status last had a report of each kind [s]."""
    contradictions: StatusContradictions
    """Statuses in a row that contradict the requests sent."""

    # Arming
    session: int = 0
    """Session of the last Arm."""
    may_be_armed: bool = False
    """Whether it may have carried out an Arm of this host since it was last disarmed."""
    feeding: Feeding
    """When its watchdog was fed."""
    clock: HeldClock
    """Its clock, synchronised with the line's clock."""

    # Sets
    played_at: float = -math.inf
    """Earliest start [s] of the last set sent, or the time when silence was sent."""
    committed: int = 0
    """Token of the set that it committed last; 0 if it committed none since it was armed."""
    _ledger: Ledger | None = None
    """None until it is identified."""
    admission: SetAdmission
    """Which set may be sent to it."""

    # Stops
    playback_bound: PlaybackBound
    """What its last stop, Clear or Arm shows about the end of its playback."""
    no_reply_cause: str | None = None
    """Why it is degraded: it did not reply to a request, and may still play."""
    disarms_sent: int = 0
    """Number of disarms, including stops, that were sent to it."""

    def __init__(
        self,
        line: Line,
        address: int,
        limits: GuardLimits,
        *,
        name: str,
        serial_number: str | None = None,
        is_output: bool | None = False,
    ) -> None:
        self.line = line
        self.address = address
        self.name = name
        self.limits = limits
        self.identification = AmplifierIdentification(
            name,
            f"address {address} on {line.name}",
            serial_number=serial_number,
            is_output=is_output,
        )
        self.reported_at = {}
        self.contradictions = StatusContradictions(name)
        self.listeners = []
        self.feeding = Feeding(line.wire.delay, line.wire.is_kept)
        self.clock = HeldClock()
        self.counts = LinkStatistics()
        self.exchange_time = cache(self._exchange_time)
        self.admission = SetAdmission(name, self.identification)
        self.playback_bound = PlaybackBound()
        self._time = line.time
        line.members[address] = self

    @property
    def identity(self) -> Values:
        """Values of its identity record, as read last; empty before."""
        return self.identification.identity

    @property
    def capabilities(self) -> Values:
        """Values of its capabilities record, as read last; empty before."""
        return self.identification.capabilities

    @property
    def ledger(self) -> Ledger:
        """The ledger; raises CommandError before the amplifier is identified."""
        if self._ledger is None:
            raise CommandError(f"amplifier {self.name} must be opened first")
        return self._ledger

    @property
    def is_in_doubt(self) -> bool:
        """Whether it has not confirmed the last set, which it may or may not play."""
        return self._ledger is not None and self._ledger.doubt is not None

    @property
    def is_playing(self) -> bool:
        """Whether any voice may play."""
        return self._ledger is not None and any(self._ledger.playback.all_voices)

    def _exchange_time(self, name: str) -> float:
        """Return how long the longest request with this name and its reply take on the wire [s]."""
        channels, layers = WIDEST
        if self.identification.is_complete:
            channels = self.capabilities["channels"]
            layers = self.capabilities["layers"]
        words = reply_words(name, channels, layers)
        if REQUESTS[name].changes_state:
            words += _EVENT_WORDS
        return self.line.wire.exchange_time(request_words(name), words)

    def request_time(self, name: str, values: Values) -> float:
        """Return how long a request and its reply take on the wire [s]."""
        duration = self.exchange_time(name)
        if name == "Set" and duration > FAST:  # most sets are much shorter than the longest one
            words = SET_WORDS + len(values["stream"])
            duration = self.line.wire.exchange_time(words, reply_words("Set"))
        return duration

    def check_may_send(self, name: str, values: Values, priority: Priority) -> None:
        """Raise if a request would play or feed and must not be sent.

        Raises LinkError while the amplifier is degraded or driven by another host, CommandRefused
        once a status has shown that it is not armed. For a set and its commit it raises Preempted
        if the set is no longer admitted, and CommandRefused if it is too late.
        """
        message = REQUESTS[name]
        if message.ends_playback or not message.feeds:
            return
        is_repeated = message is _COMMIT and values["token"] == self.committed
        now = self._time()
        if message.plays and not is_repeated:
            # A set that only silences, or changes nothing, is never too late.
            may_be_late = priority is not Priority.SET
            self.admission.check(values["token"], now, may_be_late=may_be_late)
        self.identification.check_other_host(now)
        if self.no_reply_cause is not None:
            raise LinkDegraded(
                f"{self.no_reply_cause}. The amplifier may play its last set until its watchdog "
                "has passed; nothing new is played until it replies"
            )
        if not message.arms and self.status is not None and self.status["state"] != ENABLED:
            raise disarmed(self.name, self.status)

    def note_identified(self, identity: Values, capabilities: Values) -> None:
        """Note the records of the expected amplifier; it may have lost power before."""
        if self._ledger is None:
            self._ledger = Ledger(self.limits, capabilities)
        elif not self.identification.has_same(capabilities):
            self._ledger.adopt(capabilities)
        self.identification.complete(identity, capabilities)
        self.exchange_time = cache(self._exchange_time)
        status_words = reply_words("GetStatus", capabilities["channels"], capabilities["layers"])
        status_time = self.line.wire.transit(status_words)
        self.clock.identified(capabilities["clock_error"], bits=status_time)
        self.latch = None

    def note_armed(self, session: int, watchdog: float, status: Values) -> None:
        """Note an Arm that was carried out; status: its reply; watchdog [s]."""
        self.session = session
        self.feeding.watchdog = watchdog
        self.contradictions.restart(status["latch"])
        self.ledger.forget()

    def check_other_host(self) -> None:
        """Raise LinkError if another host was heard within the longest time of a watchdog."""
        self.identification.check_other_host(self._time())

    def note_sent(self, name: str, values: Values, now: float, arrives: float) -> None:
        """Note a request that is sent now; `arrives`: when it arrives [s] unless it is delayed."""
        message = REQUESTS[name]
        self.admission.note_exchange()
        if message.shows_clock:
            # Earlier requests may be lost, so this may arrive as soon as its bits have passed.
            self.clock.sent(name, values, now, now + self.line.wire.takes)
        if message.feeds and (message.arms or values["session"] == self.session):
            self._note_possible_feeding(message, values, now, arrives)
        elif message.disarms:
            self.feeding.note_ramp(_RAMP.from_wire(values["ramp"]))
            self.disarms_sent += 1
        if message.arms:
            self.admission.withdraw()
            self.may_be_armed = True
            self.playback_bound.note_armed()
        elif message.ends_playback:
            self.admission.withdraw()
            if not message.disarms and self._ledger is not None:
                self.played_at = now
                self._ledger.may_be_silent.update(range(self._ledger.capabilities["layers"]))
        elif message.plays:
            self._note_set_sent(message, values, now, arrives)

    def _note_possible_feeding(
        self, message: Message, values: Values, now: float, arrives: float
    ) -> None:
        """Note a request that feeds the watchdog if it arrives."""
        if message.ends_playback and self.no_reply_cause is not None:
            self.feeding.note_repeated_silence(now, _RAMP.from_wire(values["ramp"]))
        else:
            self.feeding.note_sent(now, arrives)

    def _note_set_sent(self, message: Message, values: Values, now: float, arrives: float) -> None:
        """Note a part of a set or its commit, with which the admitted set may begin to play."""
        admitted = self.admission.admitted
        if admitted is None or values["token"] != admitted.token:
            return
        if message is _COMMIT:
            self._note_commit(admitted, now, arrives)
        elif admitted.is_immediate and is_last(values):
            self._note_immediate_start(admitted, now, arrives)

    def _note_commit(self, admitted: StagedSet, now: float, arrives: float) -> None:
        """Note the commit of a set, which starts at its time, or when the commit arrives."""
        error = abs(self.clock.lead(now)) + _SURELY * self.clock.scatter(now)
        self.contradictions.note_commit(now, error)
        starts_at = admitted.starts_at
        if starts_at is None or starts_at <= now:
            self.played_at = arrives
            self.ledger.sent(admitted.token, admitted.layers, now)
            return
        self.played_at = starts_at
        start_error = min(max(error, HIGH_TIME), MAX_START_ERROR)
        self.ledger.sent(admitted.token, admitted.layers, now, starts=starts_at, error=start_error)

    def _note_immediate_start(self, admitted: StagedSet, now: float, arrives: float) -> None:
        """Note a set that starts when it arrives."""
        self.contradictions.note_immediate_start()
        self.played_at = arrives
        self.ledger.sent(admitted.token, admitted.layers, now)

    def note_reply(self, name: str, values: Values, reply: Values, sent_at: float) -> None:
        """Note the reply to a request that was sent at a time [s].

        Raises CommandRefused if two consecutive statuses contradict the requests sent.
        """
        now = self._time()
        self.admission.note_exchange()
        self.counts.last_round_trip = now - sent_at
        message = REQUESTS[name]
        if message.feeds:
            self.feeding.note_reply(sent_at, now)
        if message.shows_clock:
            self._note_status(message, values, reply, sent_at, now)
        elif message.plays and reply["played"]:
            self._confirm(values["token"], now)

    def _note_status(
        self, message: Message, values: Values, status: Values, sent_at: float, now: float
    ) -> None:
        """Note a status that replies to a request sent at a time [s], see `note_reply`."""
        self._note_latch(status["latch"])
        self.status = status
        self.status_at = now
        is_enabled = status["state"] == ENABLED
        # Heartbeats show the same as the status of a Commit, unless it may show a Mark, or that the
        # amplifier is no longer armed.
        if message is not _COMMIT or len(self.line.members) > 1 or not is_enabled:
            self.clock.replied(message.name, values, status, now)
        for kind in reports_of(status, self.clock.problem(now)):
            self._note_report(kind, now)
        ledger = self._ledger
        if ledger is not None and message.ends_playback:
            ledger.note_ended(_RAMP.from_wire(values["ramp"]), sent_at, now)
            self.committed = status["token"]
            return
        self._note_token(status["token"], sent_at, now)
        if message is _PING and not is_enabled:
            raise disarmed(self.name, status)
        if ledger is not None and self.session and is_enabled and not message.changes_state:
            self.contradictions.compare(
                status,
                sent_at,
                now,
                is_fed=message.feeds,
                ledger=ledger,
                feeding=self.feeding,
                clock=self.clock,
            )

    def _note_latch(self, latch: int) -> None:
        """Note the latch of a status, unless a newer one was shown before."""
        if latch != self.latch and (self.latch is None or is_newer_token(latch, self.latch)):
            self.latch = latch

    def _note_token(self, token: int, sent_at: float, now: float) -> None:
        """Note the token of a status that was requested at a time [s].

        A set plays some time after its commit. An earlier status may show that it plays, but not
        that it does not.
        """
        is_sure = token != self.committed or sent_at >= self.played_at + COMMITTING
        if self._ledger is not None and is_sure:
            self._confirm(token, now)

    def _confirm(self, token: int, now: float) -> None:
        """Note that the amplifier has reported the set with this token as the one it plays."""
        self.committed = token
        if self._ledger is not None:
            self._ledger.resolve(token, now)
        self.admission.note_committed(token)

    def note_unasked(self, arrival: Event | OtherHost | DuplicateAddress) -> None:
        """Note a message that came without a request; an event is passed to the listeners."""
        if not isinstance(arrival, Event):
            self.identification.note_other(arrival, self._time())
            return
        for listener in self.listeners:
            try:
                listener(arrival.values)
            except Exception:
                _logger.exception("amplifier %s: a listener failed", self.name)

    def _note_report(self, kind: ReportKind, now: float) -> None:
        """Note a report of a status, and log it unless there was one a short time ago."""
        if now - self.reported_at.get(kind, -math.inf) > REPORT_LIFE:
            cause, remedy = REPORTS[kind]
            _logger.warning("amplifier %s: %s", self.name, cause, extra={"remedy": remedy})
        self.reported_at[kind] = now

    def is_silent(self, status: Values) -> bool:
        """Whether a status shows the levels of all channels, all zero."""
        if not self.identification.is_complete:
            return False
        levels = status["levels"]
        return len(levels) == self.capabilities["channels"] and not any(levels)

    def what_may_play(self, cause: str = "", stop: PendingStop | None = None) -> StopOutcome:
        """Return until when it may still play; no other function decides this.

        cause: why its state is unknown; by default the reason why it is mute or its line lost.
        stop: the stop whose outcome is wanted; None: without one, its silence is never confirmed.
        An amplifier that has confirmed a stop, and was sent neither Clear nor Arm since, is silent.
        Otherwise the watchdog ends playback; an amplifier never fed is silent once a status has
        shown it. If it plays although it has confirmed silence, or although its watchdog must have
        silenced it, another host feeds it or it is broken: nothing is certain to silence it.
        """
        until = self.playback_bound.until
        if not self.playback_bound.is_stopped:
            until = max(until, self.feeding.may_play_until)
        status = self.status
        status_at = self.status_at
        if status is not None and status_at is not None:
            is_armed = status["state"] == ENABLED
            if self.is_silent(status) and not is_armed:
                until = status_at if until == math.inf else max(until, status_at)
            elif (is_armed or any(status["levels"])) and status_at >= until:
                until = math.inf
        if until == -math.inf:
            until = math.inf
        is_confirmed = stop is not None and stop.is_confirmed
        cause = cause or self.line.loss or self.no_reply_cause or ""
        return StopOutcome(is_confirmed, until, cause)

    def go_on_from(self, earlier: "AmplifierRecord") -> None:
        """Adopt the state of the same amplifier from before its line was reopened."""
        until = earlier.what_may_play().may_play_until
        self.playback_bound = PlaybackBound(until, earlier.playback_bound.is_stopped)
        self.may_be_armed = earlier.may_be_armed

    @property
    def statistics(self) -> LinkStatistics:
        """Counts of the requests to this amplifier, and of all frames on its line."""
        return replace(self.counts, **vars(self.line.wire.counters))


def disarmed(name: str, status: Values) -> CommandRefused:
    """Return the error of a request that needs an armed amplifier, if a status shows another state.

    name: of the amplifier.
    """
    return CommandRefused(
        f"amplifier {name} is not armed but in {name_of(STATES, status['state'])}, fault "
        f"{name_of(FAULTS, status['fault'])}; once the cause is gone, clear and arm again",
        is_disarmed=True,
    )
