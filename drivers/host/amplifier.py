"""One amplifier of protocol 4 on any wire: its requests, replies and stops.

`Amplifier` identifies, arms, plays, silences, disarms and stops one amplifier. It keeps session,
latch, status and ledger, and raises CommandRefused once replies contradict the requests.
"""

import asyncio
import contextlib
import logging
import math
from collections.abc import Callable, Coroutine, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any, TypeAlias

from drivers.errors import (
    CommandError,
    CommandRefused,
    FrameError,
    LinkDegraded,
    LinkTimeout,
    Overtaken,
    Preempted,
    WrongAmplifier,
)
from drivers.host.bounds import COMMIT_DELAY
from drivers.host.clock import (
    REPORT_LIFE,
    REPORTS,
    HeldClock,
    ReportKind,
    armed_problem,
    reports_of,
)
from drivers.host.contradictions import MAX_CONTRADICTIONS, StatusContradictions
from drivers.host.ledger import (
    UNREACHED,
    Feeding,
    Ledger,
    PendingStop,
    StagedSet,
    StopOutcome,
    check_capabilities,
    check_identity,
)
from drivers.host.line import Line
from drivers.host.requests import LinkStatistics, Priority
from drivers.playing import AmplifierLayer
from drivers.protocol.definition import (
    ATTEMPTS,
    COMMAND,
    ENABLED,
    ENVELOPE,
    EVENT_RECORD,
    FAST,
    FAULTS,
    HIGH_TIME,
    KNOT,
    LATCHED,
    LAYER,
    MAX_AHEAD,
    QUANTITIES,
    REPLY_TIMEOUT,
    REQUESTS,
    SET_WORDS,
    STATES,
    STOP_RAMP,
    Message,
    name_of,
)
from drivers.protocol.records import Values
from drivers.protocol.sets import (
    PART_WORDS,
    LayerSet,
    achieved_layer,
    achieved_problem,
    is_last,
    is_newer_token,
    is_vibrating,
    pack_layers,
    parts,
)
from drivers.wires.wire import (
    WIDEST,
    DuplicateAddress,
    Event,
    OtherHost,
    reply_words,
    request_words,
)
from registry import threads
from registry.limits import GuardLimits

WATCHDOG = 0.25  # s; five heartbeats of 50 ms
DISARM_RAMP = 0.05  # s; long enough to avoid a click
OPEN_TIMEOUT = 0.5  # s; for each reply while an amplifier is opened, also on a busy machine
_ARM_WITHIN = 3.0  # s; an Arm sent later than this after its request is too late
CONFIRM_TIMEOUT = 0.3  # s; three replies of the slowest wire
LISTENING = 0.3  # s; how long the host listens for another one if it finds an armed amplifier
SECOND_REPLY = 0.02  # s; how long it waits for a second amplifier at the same address
_INTERVAL = 0.005  # s; between two attempts to stop, in addition to the ramp
_RAMP = QUANTITIES["ramp"]
_WATCHDOG = QUANTITIES["watchdog"]
_ENERGISED = (STATES["SWITCHED_ON"], ENABLED)
_WIRE_ROUNDING = 0.5  # steps of the wire, in addition to half a step of the amplifier
_LEFT = QUANTITIES["watchdog_left"]
_COMMIT = REQUESTS["Commit"]
_PING = REQUESTS["Ping"]
_EVENT_WORDS = EVENT_RECORD.words + 7
"""Words of an event, which may come before a reply in a frame of its own of 7 words."""
_SURELY = 3.0  # standard errors of a clock
_MAX_START_ERROR = 0.003  # s; if a start is known worse than this, statuses are not compared
COMMITTING = 0.1
"""Time [s] within which a commit arrives and is carried out."""
_CHECKED_FOR = 0.005  # s; a check holds for so long unless anything is sent or received
IsPreempted: TypeAlias = Callable[[], bool]
"""Whether something more urgent waits, so that a set that does not play yet is dropped."""
_logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class _CheckedSet:
    """Layers that the ledger admits, ready to be staged."""

    layers: Sequence[AmplifierLayer]
    """The layers as requested."""
    admitted: tuple[LayerSet, ...]
    """The layers as admitted."""
    stream: list[int]
    """The admitted layers as words of the wire."""
    delay: float
    """Longest time from staging until they are committed [s]."""
    valid_until: float
    """Until when the check is valid [s], if nothing is sent or received meanwhile."""


@dataclass
class _SetRequest:
    """A set that is checked when its turn on the line comes."""

    token: int
    layers: Sequence[AmplifierLayer]
    now: bool
    """Whether it plays immediately."""
    is_preempted: IsPreempted | None
    staged: StagedSet | None = None
    """The set as it was made last."""


class Amplifier:
    """An amplifier on an open line, and the exchanges with it.

    limits: configured limits. serial_number: expected serial number; None for any. is_output: the
    meaning of full level in the rig: True for the output of a linear amplifier, False for the
    motion of a stiff source, None for either.
    """

    is_identified: bool = False
    """Whether it is known to be the expected amplifier, with these capabilities.

    No status confirms silence before: it may be of another amplifier, or lack channels.
    """
    identity: Values
    """Values of its identity record, as read last; empty before."""
    capabilities: Values
    """Values of its capabilities record, as read last; empty before."""
    exchange_time: Callable[[str], float]
    """Return how long the longest request with a name and its reply take on the wire [s]."""
    counts: LinkStatistics
    """Counts of the requests to it."""
    listeners: list[Callable[[Values], None]]
    """They are called with the values of each event."""
    _serial_number: str | None
    """Expected serial number, or the one that it had when it was first identified."""

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
    _misachieved: int = 0
    """Number of contradictory achieved layers in a row."""
    _other_host_at: float = -math.inf
    """When another host was heard last [s]."""
    _are_several: bool = False
    """Whether two amplifiers have replied since this was reset."""

    # Arming
    session: int = 0
    """Session of the last Arm."""
    may_be_armed: bool = False
    """Whether it may have carried out an Arm of this host since it was last disarmed."""
    arming: tuple[int, float] = (0, -math.inf)
    """`stops_sent` when Arm was requested, and the time [s] until which the Arm may go out."""
    armed_latch: int | None = None
    """Latch in the reply to the last Arm."""
    feeding: Feeding
    """When its watchdog was fed."""
    clock: HeldClock
    """Its clock, synchronised with the line's clock."""

    # Sets
    played_at: float = -math.inf
    """Earliest start [s] of the last set sent, or the time when silence was sent."""
    _starts_at: float = -math.inf
    """Start time [s] of the staged set if committed next; a time in the past: immediately."""
    committed: int = 0
    """Token of the set that it committed last; 0 if it committed none since it was armed."""
    _may_wait_until: float = -math.inf
    """Latest start of the last set with a poor clock [s]."""
    _is_start_known: bool = True
    """Whether the start is known well enough to compare statuses with the sent sets."""
    _ledger: Ledger | None = None
    """None until it is identified."""
    _admitted: StagedSet | None = None
    """The set that is staged and not committed yet."""
    _checked: _CheckedSet | None = None
    """The layers that were checked last, if this check can be used again."""

    # Stops
    stop_outcome: StopOutcome = UNREACHED
    """Its possible output after the last stop, without the evidence of statuses and watchdog;
    `what_may_play` has the conclusion."""
    no_reply_cause: str | None = None
    """Why it is degraded: it did not reply to a request, and may still play."""
    stops_sent: int = 0
    """Number of stops and disarms that were sent to it."""
    _stop: PendingStop | None = None
    """The last stop, which later callers join until it was sent."""

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
        self.is_output = is_output
        self.capabilities = {}
        self.identity = {}
        self.reported_at = {}
        self.contradictions = StatusContradictions()
        self.listeners = []
        self.feeding = Feeding(line.wire.delay, line.wire.is_kept)
        self.clock = HeldClock()
        self.counts = LinkStatistics()
        self.exchange_time = cache(self._exchange_time)
        self._serial_number = serial_number
        self._time = line.time
        line.members[address] = self

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

    def _exchange_time(self, name: str) -> float:
        """Return how long the longest request with this name and its reply take on the wire [s]."""
        channels, layers = WIDEST
        if self.is_identified:
            channels = self.capabilities["channels"]
            layers = self.capabilities["layers"]
        words = reply_words(name, channels, layers)
        if REQUESTS[name].changes_state:
            words += _EVENT_WORDS
        return self.line.wire.exchange_time(request_words(name), words)

    async def stage(
        self,
        token: int,
        layers: Sequence[AmplifierLayer],
        *,
        now: bool = False,
        priority: Priority = Priority.SET,
        is_preempted: IsPreempted | None = None,
    ) -> StagedSet:
        """Stage a set under a token, or play it immediately if `now`.

        The ledger admits it when its turn on the line comes, unless it is preempted then. Raises
        CommandRefused with the reason; Preempted if a stop came first; FrameError if two replies in
        a row have another token.
        """
        request = _SetRequest(token, layers, now, is_preempted)
        for _ in range(MAX_CONTRADICTIONS):
            reply = await self.line.submit(self, priority, "Set", partial(self._make_set, request))
            if reply["token"] == token:
                break
        else:
            problem = f"a set with token {token} must be taken, got token {reply['token']}"
            # This is not a rejection: the group stops all amplifiers.
            raise FrameError(str(_contradicted(self.name, problem)))
        staged = request.staged
        is_staged = reply["staged"] and not now and self._admitted is staged
        if staged is None or not (reply["played"] or is_staged):
            raise Preempted(f"amplifier {self.name}: set {token} was not staged")
        return staged if reply["exact"] else replace(staged, is_exact=False)

    def _make_set(self, request: _SetRequest) -> list[Values]:
        """Check a set, and return the values of its parts; raises CommandRefused or Overtaken."""
        token = request.token
        if request.is_preempted is not None and request.is_preempted():
            raise Overtaken(f"amplifier {self.name}: set {token} is preempted")
        moment = self._time()
        checked = self._checked
        if checked is None or checked.layers is not request.layers or moment > checked.valid_until:
            checked = self._check(request.layers, moment)
        self._checked = None
        messages = parts(checked.stream, session=self.session, token=token, now=request.now)
        request.staged = StagedSet(token, checked.admitted, True, until=moment + checked.delay)
        self._admitted = request.staged
        return messages

    def refusal_of(self, layers: Sequence[AmplifierLayer]) -> CommandRefused | None:
        """Return why the ledger would not admit layers now; None if it would.

        The result is used again if the layers are staged within 5 ms and nothing is sent or
        received meanwhile.
        """
        moment = self._time()
        try:
            self._checked = self._check(layers, moment, valid_for=_CHECKED_FOR)
        except CommandRefused as error:
            return error
        return None

    def _check(
        self, layers: Sequence[AmplifierLayer], moment: float, *, valid_for: float = 0.0
    ) -> _CheckedSet:
        """Check layers for staging within a time after a moment [s]; raises CommandRefused."""
        set_time = len(self.line.members) * self.exchange_time("Set")
        delay = max(COMMIT_DELAY, ATTEMPTS * set_time)
        words = _word_count(layers)
        if words > PART_WORDS:  # parts for all amplifiers of the line, each perhaps repeated
            delay += 2 * words / PART_WORDS * set_time
        admitted = self.ledger.admit(layers, moment, delay=delay + valid_for)
        stream = pack_layers(admitted)
        if not self.is_identified and is_vibrating(*admitted):
            raise CommandRefused(f"amplifier {self.name} must be identified first; open it again")
        max_words = self.ledger.capabilities["set_words"]
        if len(stream) > max_words:
            raise CommandRefused(f"a set must have at most {max_words} words, got {len(stream)}")
        return _CheckedSet(layers, admitted, stream, delay, moment + valid_for)

    def set_start(self, moment: float | None) -> None:
        """Set when the staged set starts [s] once it is committed; None: immediately."""
        self._starts_at = -math.inf if moment is None else moment

    def commit(self, token: int, at: int) -> asyncio.Future[Values]:
        """Play the staged set; returns a future of the status, which shows the tokens.

        at: high word of the amplifier's clock at which it starts. The future raises Preempted if a
        stop or disarm came first, CommandRefused if it is too late for the ledger's admission.
        """
        values = {"session": self.session, "token": token, "at": at}
        return self.line.submit(self, Priority.SET, "Commit", values)

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
        if message.silences or not message.feeds:
            return
        is_repeated = message is _COMMIT and values["token"] == self.committed
        if message.plays and not is_repeated:
            self._check_admitted(values["token"], priority)
        if message.arms:
            stops_sent, until = self.arming
            if self.stops_sent != stops_sent:
                raise Preempted(f"amplifier {self.name}: a stop or disarm came first")
            if self._time() > until:  # this machine slept, and the caller does not expect it now
                raise LinkTimeout(f"amplifier {self.name}: identified too late; arm again")
        if self._other_host_at > -math.inf:
            self.check_other_host()
        if self.no_reply_cause is not None:
            raise LinkDegraded(
                f"{self.no_reply_cause}. The amplifier may play its last set until its watchdog "
                "has passed; nothing new is played until it replies"
            )
        if not message.arms and self.status is not None and self.status["state"] != ENABLED:
            raise _disarmed(self.name, self.status)

    def _check_admitted(self, token: int, priority: Priority) -> None:
        """Raise Preempted or CommandRefused unless the set with a token may be sent now."""
        admitted = self._admitted
        if admitted is None or admitted.token != token:
            raise Preempted(f"amplifier {self.name}: a stop, disarm or newer set came first")
        now = self._time()
        if now > admitted.until and priority is Priority.SET:  # silence is never too late
            raise CommandRefused(
                f"amplifier {self.name}: set {token} must be committed "
                f"{now - admitted.until:.3g} s earlier; the wire is too slow or too busy",
                until=now,
            )

    def note_sent(self, name: str, values: Values, now: float, arrives: float) -> None:
        """Note a request that is sent now; `arrives`: when it arrives [s] unless it is delayed."""
        message = REQUESTS[name]
        self._checked = None
        if message.shows_clock:
            # Earlier requests may be lost, so this may arrive as soon as its bits have passed.
            self.clock.sent(name, values, now, now + self.line.wire.takes)
        if message.feeds and (message.arms or values["session"] == self.session):
            self._note_possible_feeding(message, values, now, arrives)
        elif message.disarms:
            self.feeding.fade = max(self.feeding.fade, _RAMP.from_wire(values["ramp"]))
            self.stops_sent += 1
        admitted = self._admitted
        if message.arms:
            self._admitted = None
            self.may_be_armed = True
            self.stop_outcome = replace(
                self.stop_outcome, is_confirmed=False, may_play_until=-math.inf
            )
        elif message.silences:
            self._admitted = None
            if not message.disarms and self._ledger is not None:
                self.played_at = now
                self._ledger.may_be_silent.update(range(self._ledger.capabilities["layers"]))
        elif message.plays and admitted is not None and values["token"] == admitted.token:
            if message is _COMMIT:
                self._note_commit(admitted, now, arrives)
            elif values["now"] and is_last(values):
                self._note_immediate_start(admitted, now, arrives)

    def _note_possible_feeding(
        self, message: Message, values: Values, now: float, arrives: float
    ) -> None:
        """Note a request that feeds the watchdog if it arrives."""
        feeding = self.feeding
        feeding.may = now
        if message.silences and self.no_reply_cause is not None:
            # If it arrives, it does so within the time of the watchdog, and its ramp follows.
            # Repeating it without reply does not put off when the amplifier must be silent.
            feeding.fade = max(feeding.fade, _RAMP.from_wire(values["ramp"]))
        else:
            feeding.plays = now
            feeding.arrives = arrives
            feeding.fade = 0.0

    def _note_commit(self, admitted: StagedSet, now: float, arrives: float) -> None:
        """Note the commit of a set, which starts at `_starts_at`, or when the commit arrives."""
        error = abs(self.clock.lead(now)) + _SURELY * self.clock.scatter(now)
        self._is_start_known = error <= _MAX_START_ERROR
        self._may_wait_until = now + MAX_AHEAD
        if self._starts_at <= now:
            self.played_at = arrives
            self.ledger.sent(admitted.token, admitted.layers, now)
            return
        self.played_at = self._starts_at
        start_error = min(max(error, HIGH_TIME), _MAX_START_ERROR)
        self.ledger.sent(
            admitted.token, admitted.layers, now, starts=self._starts_at, error=start_error
        )

    def _note_immediate_start(self, admitted: StagedSet, now: float, arrives: float) -> None:
        """Note a set that starts when it arrives."""
        self._may_wait_until = -math.inf
        self.played_at = arrives
        self.ledger.sent(admitted.token, admitted.layers, now)

    def note_reply(self, name: str, values: Values, reply: Values, sent_at: float) -> None:
        """Note the reply to a request that was sent at a time [s].

        Raises CommandRefused if two consecutive statuses contradict the requests sent.
        """
        now = self._time()
        self._checked = None
        self.counts.last_round_trip = now - sent_at
        message = REQUESTS[name]
        if message.feeds:
            self._note_feeding(sent_at, now)
        if message.shows_clock:
            self._note_status(message, values, reply, sent_at, now)
        elif message.plays and reply["played"]:
            self._confirm(values["token"], now)

    def _note_feeding(self, sent_at: float, now: float) -> None:
        """Note that a request has surely fed the watchdog."""
        feeding = self.feeding
        feeding.since = sent_at
        feeding.confirmed_at = now
        if sent_at > feeding.plays:
            feeding.plays = sent_at
            feeding.fade = 0.0

    def _note_status(
        self, message: Message, values: Values, status: Values, sent_at: float, now: float
    ) -> None:
        """Note a status that replies to a request sent at a time [s], see `note_reply`."""
        latch = status["latch"]
        if latch != self.latch and (self.latch is None or is_newer_token(latch, self.latch)):
            self.latch = latch
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
        if ledger is not None and message.silences:
            ledger.silenced(_RAMP.from_wire(values["ramp"]), sent_at, now)
            self.committed = status["token"]
            return
        # A set plays some time after its commit. An earlier status may show that it plays, but not
        # that it does not.
        is_sure = status["token"] != self.committed or sent_at >= self.played_at + COMMITTING
        if ledger is not None and is_sure:
            self._confirm(status["token"], now)
        if message is _PING and not is_enabled:
            raise _disarmed(self.name, status)
        if ledger is not None and self.session and is_enabled and not message.changes_state:
            self._compare(ledger, status, sent_at, now, is_fed=message.feeds)

    def _compare(
        self, ledger: Ledger, status: Values, sent_at: float, now: float, *, is_fed: bool
    ) -> None:
        """Compare the status of an armed amplifier with the requests that were sent.

        is_fed: whether the request for the status feeds the watchdog. Raises CommandRefused for the
        second contradiction in a row.
        """
        problem = self._problem_of(ledger, status, sent_at, now, is_fed=is_fed)
        if problem is None:
            # The reply to a request that feeds does not show how the watchdog runs down.
            shows_watchdog = not is_fed and self.feeding.tells(sent_at)
            self.contradictions.note_agreement(shows_watchdog=shows_watchdog)
        elif self.contradictions.note_contradiction(now, is_fed=is_fed):
            raise _contradicted(self.name, problem)

    def _problem_of(
        self, ledger: Ledger, status: Values, sent_at: float, now: float, *, is_fed: bool
    ) -> str | None:
        """Describe a contradiction in the status of an armed amplifier; None without one."""
        problem = armed_problem(status, self.armed_latch)
        if problem is None and not is_fed:
            left = status["watchdog_left"] / _LEFT.per_unit
            problem = self.feeding.problem(left, sent_at, now)
        if problem is not None:
            return problem
        problem = ledger.problem_of(status, sent_at, now)
        if problem is None or sent_at >= self._may_wait_until:
            return problem
        # If its clock is not synchronised, a set may wait even though it was committed.
        is_synchronised = self._is_start_known and self.clock.error(now) < math.inf
        return problem if is_synchronised else None

    def note_unasked(self, arrival: Event | OtherHost | DuplicateAddress) -> None:
        """Note a message that came without a request; an event is passed to the listeners."""
        if isinstance(arrival, OtherHost):
            self._other_host_at = self._time()
        elif isinstance(arrival, DuplicateAddress):
            self._are_several = True
        else:
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

    def wire_ramp(self, ramp: float) -> int:
        """Return the nearest ramp [s] that the amplifier can play, in units of the wire.

        Any number is accepted, since silence must never be refused for its ramp.
        """
        if math.isnan(ramp):
            return _RAMP.to_wire(STOP_RAMP)
        wire_ramp = _RAMP.to_wire(min(max(ramp, 0.0), _RAMP.high))
        if not self.is_identified:
            return wire_ramp
        ramp_max: int = self.capabilities["ramp_max"]
        return min(wire_ramp, ramp_max)

    def is_silent(self, status: Values) -> bool:
        """Whether a status shows the levels of all channels, all zero."""
        if not self.is_identified:
            return False
        levels = status["levels"]
        return len(levels) == self.capabilities["channels"] and not any(levels)

    def what_may_play(self, cause: str = "") -> StopOutcome:
        """Return how long it may still play: the only place where that is decided.

        cause: why its state is unknown; by default the reason why it is mute or its line lost. An
        amplifier that confirmed a stop, and received neither Clear nor Arm since, is silent.
        Otherwise the watchdog ends playback; an amplifier never fed is silent once a status has
        shown it. If it plays although it has confirmed silence, or although its watchdog must have
        silenced it, another host feeds it or it is broken: nothing is certain to silence it.
        """
        status = self.status
        status_at = self.status_at
        until = self.stop_outcome.may_play_until
        if not self.stop_outcome.is_confirmed:
            until = max(until, self.feeding.may_play_until)
        if status is not None and status_at is not None:
            is_armed = status["state"] == ENABLED
            if self.is_silent(status) and not is_armed:
                until = status_at if until == math.inf else max(until, status_at)
            elif (is_armed or any(status["levels"])) and status_at >= until:
                until = math.inf
        cause = cause or self.line.loss or self.no_reply_cause or ""
        return StopOutcome(False, math.inf if until == -math.inf else until, cause)

    def check_other_host(self) -> None:
        """Raise LinkError if another host was heard within the longest time of a watchdog."""
        if self._time() - self._other_host_at <= _WATCHDOG.high:
            raise _driven_by_another(self.name)

    def _confirm(self, token: int, now: float) -> None:
        """Note that the amplifier has reported the set with this token as the one it plays."""
        self.committed = token
        if self._ledger is not None:
            self._ledger.resolve(token, now)
        if self._admitted is not None and self._admitted.token == token:
            self._admitted = None

    def go_on_from(self, earlier: "Amplifier") -> None:
        """Adopt the state of the same amplifier from before its line was reopened."""
        self.stop_outcome = replace(
            earlier.what_may_play(), is_confirmed=earlier.stop_outcome.is_confirmed
        )
        self.may_be_armed = earlier.may_be_armed

    async def open(self) -> None:
        """Identify the amplifier and leave it disarmed; a latched stop or fault stays latched.

        Raises LinkError if it is another amplifier, speaks another version, or is driven by another
        host.
        """
        status = await self.identify()
        if status["state"] == ENABLED:
            await self._listen_for_another_host(status)
            await self.disarm(STOP_RAMP)

    async def identify(self, *, timeout: float = OPEN_TIMEOUT) -> Values:
        """Read identity and capabilities, and return the status; raises LinkError.

        timeout: for each reply [s]. The newest latch is then the one in this status, because the
        amplifier may have lost power before.
        """
        self._are_several = False
        try:
            identity = await self.request("Hello", {}, Priority.OTHER, timeout=timeout)
            await asyncio.sleep(SECOND_REPLY)
        except LinkTimeout:
            self._check_alone()
            raise
        self._check_alone()
        was_identified = self.is_identified
        self.forget_identification()  # remains so if the identity is wrong
        check_identity(identity, self.name, self._serial_number)
        self.is_identified = was_identified
        can = await self.request("GetCaps", {}, Priority.OTHER, timeout=timeout)
        check_capabilities(can, self.name, is_output=self.is_output)
        if self._ledger is None:
            self._ledger = Ledger(self.limits, can)
        elif not self.is_identified or can != self.capabilities:
            self._ledger.adopt(can)
        self.identity = identity
        self.capabilities = can
        self.is_identified = True
        self.exchange_time = cache(self._exchange_time)
        status_words = reply_words("GetStatus", can["channels"], can["layers"])
        self.clock.identified(can["clock_error"], bits=self.line.wire.transit(status_words))
        self._serial_number = identity["serial_number"]
        self.latch = None
        return await self.read_status()

    def forget_identification(self) -> None:
        """Let no status confirm silence until the amplifier is identified again."""
        self.is_identified = False

    def _check_alone(self) -> None:
        """Raise LinkError if several amplifiers replied: the silence of one proves nothing."""
        if self._are_several:
            self.forget_identification()
            raise WrongAmplifier(
                f"amplifier {self.name}: several amplifiers reply at address {self.address} on "
                f"{self.line.name}; give each its own: era amp address --serial-number"
            )

    def arm(self, session: int, watchdog: float = WATCHDOG) -> Coroutine[Any, Any, Values]:
        """Switch the high voltage on at level zero, and return the status; watchdog [s].

        Identifies the amplifier again, because it may have lost power and returned with other
        limits. A stop or disarm that comes after this call goes first, even before it is awaited.
        """
        self.arming = self.stops_sent, threads.now() + _ARM_WITHIN
        return self._arm(session, watchdog)

    async def _arm(self, session: int, watchdog: float) -> Values:
        # The timeout is short so that the watchdogs of other armed amplifiers do not run down.
        await self.identify(timeout=REPLY_TIMEOUT)
        wire = _WATCHDOG.to_wire(watchdog)
        low = self.ledger.capabilities["watchdog_min"]
        high = self.ledger.capabilities["watchdog_max"]
        if not low <= wire <= high:
            bounds = f"{_WATCHDOG.from_wire(low):g} to {_WATCHDOG.from_wire(high):g}"
            raise CommandError(f"watchdog must be {bounds} s, got {watchdog:g} s")
        self.feeding.watchdog = max(self.feeding.watchdog, watchdog)

        def make() -> list[Values]:
            shift = self.clock.shift(self._time())
            return [{"session": session, "watchdog": wire, "shift": shift}]

        was_armed = self.may_be_armed
        try:
            status = await self.line.submit(self, Priority.ARM, "Arm", make)
        except CommandRefused as error:
            if not (isinstance(error, Preempted) or error.may_play):
                self.may_be_armed = was_armed
            raise
        self.session = session
        self.feeding.watchdog = watchdog
        self.armed_latch = status["latch"]
        self.contradictions.restart()
        self._misachieved = 0
        self.ledger.forget()
        if status["state"] != ENABLED:
            raise _disarmed(self.name, status)
        return status

    async def read_achieved(self, layer: LayerSet, token: int) -> LayerSet:
        """Read how the amplifier plays a layer of the set with this token.

        The ledger uses the result from then on. A layer that continues an earlier set is returned
        as it was sent. Raises CommandRefused if the amplifier contradicts two sets in a row.
        """
        reply = await self.request("GetAchieved", {"layer": layer.layer}, Priority.SET)
        if layer.renew or reply["token"] != token:
            return layer
        can = self.ledger.capabilities
        problem = achieved_problem(layer, reply, can, is_exact=False, slack=_WIRE_ROUNDING)
        achieved = achieved_layer(layer, reply, can)
        if problem is None:
            self._misachieved = 0
            self.ledger.correct(layer, achieved, token)
            return achieved
        self._misachieved += 1
        if self._misachieved >= MAX_CONTRADICTIONS:
            _, quantity, must, got = problem
            raise _contradicted(
                self.name, f"{quantity} in layer {layer.layer} must be {must}, got {got}"
            )
        return achieved

    async def silence(self, ramp: float) -> Values:
        """Let all layers fall silent along a ramp [s]; the amplifier stays armed."""
        return await self.request(
            "Silence",
            {"session": self.session, "ramp": self.wire_ramp(ramp)},
            Priority.SILENCE,
        )

    async def disarm(self, ramp: float = DISARM_RAMP) -> None:
        """Ramp to silence [s] and switch the high voltage off; read back until it is silent.

        Raises CommandRefused if the amplifier is not silent soon after the ramp, or is still armed.
        """
        status = await self.request("Disarm", {"ramp": self.wire_ramp(ramp)}, Priority.SILENCE)
        end = threads.now() + ramp + CONFIRM_TIMEOUT
        while status["state"] in _ENERGISED or not self.is_silent(status):
            if threads.now() > end or status["state"] == ENABLED:
                raise CommandRefused(f"amplifier {self.name} is not silent after a disarm")
            await asyncio.sleep(_INTERVAL)
            status = await self.read_status(Priority.SILENCE)
        self.may_be_armed = False

    def ping(self) -> "asyncio.Future[Values]":
        """Feed the watchdog and steer the clock; returns a future of the status.

        The future raises CommandRefused if the amplifier is not armed.
        """

        def make() -> list[Values]:
            is_playing = self._ledger is not None and any(self._ledger.playback.all_voices)
            rate = self.clock.rate(self._time(), is_playing=is_playing)
            return [{"session": self.session, "rate": rate}]

        return self.line.submit(self, Priority.HEARTBEAT, "Ping", make)

    def read_status(self, priority: Priority = Priority.OTHER) -> "asyncio.Future[Values]":
        """Read the status; this does not feed the watchdog."""
        return self.line.submit(self, priority, "GetStatus", {})

    async def clear(self) -> Values:
        """Acknowledge the newest stop or fault that the amplifier has shown.

        Identifies the amplifier again: after a loss of power it counts latches from 1.
        """
        last_stops_sent = self.stops_sent
        last_latch = self.latch
        status = await self.identify(timeout=REPLY_TIMEOUT)
        has_restarted = last_latch is None or is_newer_token(last_latch, status["latch"])
        latch = status["latch"] if has_restarted else last_latch
        if self.stops_sent != last_stops_sent:
            raise Preempted(f"amplifier {self.name}: a stop or disarm came first")
        self.stop_outcome = replace(self.stop_outcome, is_confirmed=False)
        return await self.request("Clear", {"latch": latch}, Priority.CLEAR)

    def stop(
        self, ramp: float = STOP_RAMP, *, timeout: float = CONFIRM_TIMEOUT
    ) -> "asyncio.Future[StopOutcome]":
        """Stop along a ramp [s] and latch; the request is queued when this returns.

        The future ends once silence is confirmed, or when a timeout [s] has passed after the
        request went out. Calls before that join the same stop, which goes on if a caller is
        cancelled.
        """
        stop = self._stop
        if stop is None or stop.is_sent or stop.result.done():
            members = len(self.line.members)
            wire_ramp = self.wire_ramp(ramp)
            # On a shared line each amplifier has three exchanges: a stop and two statuses.
            timeout += ATTEMPTS * members * self.exchange_time("GetStatus")
            timeout += _RAMP.from_wire(wire_ramp)
            ends = threads.now() + timeout * (members + 1)  # others may keep the line busy
            stop = PendingStop(wire_ramp, timeout, ends)
            self._stop = stop
            stop.result = asyncio.ensure_future(self._confirm_stop(stop))
            with contextlib.suppress(Exception):  # then `_confirm_stop` makes the request
                stop.requested = self._request_stop(stop)
        return asyncio.shield(stop.result)

    def _request_stop(self, stop: PendingStop) -> "asyncio.Future[Values]":
        stop.latch = self.latch
        return self.line.submit(self, Priority.STOP, "Stop", stop.sent)

    async def _confirm_stop(self, stop: PendingStop) -> StopOutcome:
        """Repeat a stop until its silence is confirmed, or its timeout has passed.

        A status confirms it if its state is latched, its latch is newer than each one seen before,
        and the levels of all channels are zero. Any other status may be old and only late.
        """
        cause = ""
        pause = _RAMP.from_wire(stop.ramp) + _INTERVAL
        try:
            async with asyncio.timeout_at(stop.ends) as stop.limit:
                while self.line.loss is None:
                    try:
                        request = stop.requested
                        stop.requested = None
                        status = await (request or self._request_stop(stop))
                        while _is_stopping(status, stop.latch):
                            if self.is_silent(status):
                                self.stop_outcome = StopOutcome(True, threads.now())
                                return self.stop_outcome
                            await asyncio.sleep(_INTERVAL)
                            status = await self.read_status(Priority.STOP)
                    except Exception as error:  # the stop continues after any failure
                        cause = str(error) or type(error).__name__
                    await asyncio.sleep(pause)
        except TimeoutError:
            cause = cause or f"silence was not reported within {stop.timeout:g} s"
        return self.what_may_play(self.line.loss or cause)

    async def request(
        self,
        name: str,
        values: Values,
        priority: Priority = Priority.OTHER,
        *,
        timeout: float = REPLY_TIMEOUT,
    ) -> Values:
        """Send a request that the ledger need not admit; returns the values of its reply."""
        return await self.line.submit(self, priority, name, values, timeout=timeout)

    @property
    def statistics(self) -> LinkStatistics:
        """Counts of the requests to this amplifier, and of all frames on its line."""
        return replace(self.counts, **vars(self.line.wire.counters))

    async def _listen_for_another_host(self, status: Values) -> None:
        """Raise LinkError if another host feeds its watchdog while this one listens."""
        end = threads.now() + LISTENING
        left = status["watchdog_left"]
        while threads.now() < end and status["state"] == ENABLED:
            await asyncio.sleep(LISTENING / 10)
            status = await self.read_status()
            self.check_other_host()
            if status["watchdog_left"] > left:
                raise _driven_by_another(self.name)
            left = status["watchdog_left"]


def _word_count(layers: Sequence[AmplifierLayer]) -> int:
    """Return how many words layers have on the wire."""
    words = LAYER.words * len(layers)
    for layer in layers:
        words += COMMAND.words * len(layer.tones)
        for tone in layer.tones:
            for envelope in (tone.onset, tone.ending):
                if envelope is not None:
                    words += ENVELOPE.words + KNOT.words * len(envelope.knots)
    return words


def _is_stopping(status: Values, last_latch: int | None) -> bool:
    """Whether a status shows a stop that was carried out after this latch was the newest."""
    if last_latch is None or status["state"] not in LATCHED:
        return False
    return status["latch"] > 0 and is_newer_token(status["latch"], last_latch)


def _contradicted(name: str, problem: str) -> CommandRefused:
    """Return the error of an amplifier that contradicts its requests again and again."""
    return CommandRefused(
        f"amplifier {name} contradicts its requests: {problem}; look for a derated or broken "
        "channel, an exchanged cable or firmware, then clear and arm again"
    )


def _disarmed(name: str, status: Values) -> CommandRefused:
    """Return the error of a request that needs an armed amplifier, if a status shows another state.

    name: of the amplifier.
    """
    return CommandRefused(
        f"amplifier {name} is not armed but in {name_of(STATES, status['state'])}, fault "
        f"{name_of(FAULTS, status['fault'])}; once the cause is gone, clear and arm again",
        is_disarmed=True,
    )


def _driven_by_another(name: str) -> WrongAmplifier:
    """Return the error of an amplifier that another host drives."""
    return WrongAmplifier(f"amplifier {name} is driven by another host; end that one first")
