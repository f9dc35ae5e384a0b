"""One amplifier of protocol 4 on any wire: its requests, and what their replies show.

`Amplifier` identifies, arms, plays, silences, disarms and stops one amplifier. Each request and
each reply is noted by the objects that keep its state: `AmplifierIdentification`, `SetAdmission`
(which set may be sent) with the `Ledger`, `Feeding` (the watchdog), `HeldClock`,
`StatusContradictions`, and `PlaybackBound` with `PendingStop`. `what_may_play` concludes from them
what it may still play.
"""

import asyncio
import contextlib
import logging
import math
from collections.abc import Callable, Coroutine, Sequence
from dataclasses import replace
from functools import cache, partial
from typing import Any

from drivers.errors import (
    CommandError,
    CommandRefused,
    FrameError,
    LinkDegraded,
    LinkTimeout,
    Preempted,
)
from drivers.host.clock import REPORT_LIFE, REPORTS, HeldClock, ReportKind, reports_of
from drivers.host.contradictions import (
    MAX_CONTRADICTIONS,
    MAX_START_ERROR,
    StatusContradictions,
    contradicted,
)
from drivers.host.identification import AmplifierIdentification, driven_by_another
from drivers.host.ledger import Ledger, StagedSet
from drivers.host.line import Line
from drivers.host.requests import LinkStatistics, Priority
from drivers.host.set_admission import IsPreempted, SetAdmission, SetRequest
from drivers.host.stops import CONFIRM_INTERVAL, PendingStop, PlaybackBound, StopOutcome
from drivers.host.watchdog import Feeding
from drivers.playing import AmplifierLayer
from drivers.protocol.definition import (
    ATTEMPTS,
    ENABLED,
    EVENT_RECORD,
    FAST,
    FAULTS,
    HIGH_TIME,
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
    LayerSet,
    achieved_layer,
    achieved_problem,
    is_last,
    is_newer_token,
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
_RAMP = QUANTITIES["ramp"]
_WATCHDOG = QUANTITIES["watchdog"]
_ENERGISED = (STATES["SWITCHED_ON"], ENABLED)
_WIRE_ROUNDING = 0.5  # steps of the wire, in addition to half a step of the amplifier
_COMMIT = REQUESTS["Commit"]
_PING = REQUESTS["Ping"]
_EVENT_WORDS = EVENT_RECORD.words + 7
"""Words of an event, which may come before a reply in a frame of its own of 7 words."""
_SURELY = 3.0  # standard errors of a clock
COMMITTING = 0.1
"""Time [s] within which a commit arrives and is carried out."""
_logger = logging.getLogger(__name__)


class Amplifier:
    """An amplifier on an open line, and the exchanges with it.

    limits: configured limits. serial_number: expected serial number; None for any. is_output: the
    meaning of full level in the rig: True for the output of a linear amplifier, False for the
    motion of a stiff source, None for either.
    """

    identification: AmplifierIdentification
    """What it has reported about itself."""
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
    _disarms_before_arm: int = 0
    """`disarms_sent` when Arm was requested: a later stop or disarm prevents it."""
    _arms_until: float = -math.inf
    """Until when the requested Arm may go out [s]."""
    feeding: Feeding
    """When its watchdog was fed."""
    clock: HeldClock
    """Its clock, synchronised with the line's clock."""

    # Sets
    played_at: float = -math.inf
    """Earliest start [s] of the last set sent, or the time when silence was sent."""
    _starts_at: float = -math.inf
    """Start [s] of the staged set by the next commit; a time in the past: immediately."""
    committed: int = 0
    """Token of the set that it committed last; 0 if it committed none since it was armed."""
    _ledger: Ledger | None = None
    """None until it is identified."""
    _sets: SetAdmission
    """Which set may be sent to it."""

    # Stops
    playback_bound: PlaybackBound
    """What its last stop, Clear or Arm shows about the end of its playback."""
    no_reply_cause: str | None = None
    """Why it is degraded: it did not reply to a request, and may still play."""
    disarms_sent: int = 0
    """Number of disarms, including stops, that were sent to it."""
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
        self._sets = SetAdmission(name, self.identification)
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
        request = SetRequest(token, layers, now, is_preempted)
        for _ in range(MAX_CONTRADICTIONS):
            reply = await self.line.submit(self, priority, "Set", partial(self._make_set, request))
            if reply["token"] == token:
                break
        else:
            problem = f"a set with token {token} must be taken, got token {reply['token']}"
            # This is not a rejection: the group stops all amplifiers.
            raise FrameError(str(contradicted(self.name, problem)))
        staged = request.staged
        is_staged = reply["staged"] and not now and self._sets.admitted is staged
        if staged is None or not (reply["played"] or is_staged):
            raise Preempted(f"amplifier {self.name}: set {token} was not staged")
        return staged if reply["exact"] else replace(staged, is_exact=False)

    def _make_set(self, request: SetRequest) -> list[Values]:
        """Admit a set, and return the values of its parts; raises CommandRefused or Overtaken."""
        return self._sets.admit(
            request, self.ledger, self._time(), session=self.session, set_time=self._sets_time()
        )

    def refusal_of(self, layers: Sequence[AmplifierLayer]) -> CommandRefused | None:
        """Return why the ledger would not admit layers now; None if it would."""
        return self._sets.refusal_of(layers, self.ledger, self._time(), set_time=self._sets_time())

    def _sets_time(self) -> float:
        """Return how long sets to all amplifiers of the line take [s]."""
        return len(self.line.members) * self.exchange_time("Set")

    def expect_commit(self, starts_at: float | None) -> None:
        """Expect a commit that starts the staged set at a time [s]; None: immediately."""
        self._starts_at = -math.inf if starts_at is None else starts_at

    def commit(self, token: int, at: int, starts_at: float | None) -> asyncio.Future[Values]:
        """Play the staged set; returns a future of the status, which shows the tokens.

        at: high word of the amplifier's clock at which it starts; starts_at: that moment [s], None
        for an immediate start. The future raises Preempted if a stop or disarm came first,
        CommandRefused if it is too late for the ledger's admission.
        """
        self.expect_commit(starts_at)
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
        if message.ends_playback or not message.feeds:
            return
        is_repeated = message is _COMMIT and values["token"] == self.committed
        now = self._time()
        if message.plays and not is_repeated:
            # A set that only silences, or changes nothing, is never too late.
            may_be_late = priority is not Priority.SET
            self._sets.check(values["token"], now, may_be_late=may_be_late)
        if message.arms:
            self._check_may_arm(now)
        self.identification.check_other_host(now)
        if self.no_reply_cause is not None:
            raise LinkDegraded(
                f"{self.no_reply_cause}. The amplifier may play its last set until its watchdog "
                "has passed; nothing new is played until it replies"
            )
        if not message.arms and self.status is not None and self.status["state"] != ENABLED:
            raise _disarmed(self.name, self.status)

    def _check_may_arm(self, now: float) -> None:
        """Raise Preempted or LinkTimeout if a requested Arm must not be sent any more."""
        if self.disarms_sent != self._disarms_before_arm:
            raise Preempted(f"amplifier {self.name}: a stop or disarm came first")
        if now > self._arms_until:  # this machine slept, and the caller does not expect it now
            raise LinkTimeout(f"amplifier {self.name}: identified too late; arm again")

    def note_sent(self, name: str, values: Values, now: float, arrives: float) -> None:
        """Note a request that is sent now; `arrives`: when it arrives [s] unless it is delayed."""
        message = REQUESTS[name]
        self._sets.expire_check()
        if message.shows_clock:
            # Earlier requests may be lost, so this may arrive as soon as its bits have passed.
            self.clock.sent(name, values, now, now + self.line.wire.takes)
        if message.feeds and (message.arms or values["session"] == self.session):
            self._note_possible_feeding(message, values, now, arrives)
        elif message.disarms:
            self.feeding.note_ramp(_RAMP.from_wire(values["ramp"]))
            self.disarms_sent += 1
        if message.arms:
            self._sets.withdraw()
            self.may_be_armed = True
            self.playback_bound.note_armed()
        elif message.ends_playback:
            self._sets.withdraw()
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
        admitted = self._sets.admitted
        if admitted is None or values["token"] != admitted.token:
            return
        if message is _COMMIT:
            self._note_commit(admitted, now, arrives)
        elif values["now"] and is_last(values):
            self._note_immediate_start(admitted, now, arrives)

    def _note_commit(self, admitted: StagedSet, now: float, arrives: float) -> None:
        """Note the commit of a set, which starts at `_starts_at`, or when the commit arrives."""
        error = abs(self.clock.lead(now)) + _SURELY * self.clock.scatter(now)
        self.contradictions.note_commit(now, error)
        if self._starts_at <= now:
            self.played_at = arrives
            self.ledger.sent(admitted.token, admitted.layers, now)
            return
        self.played_at = self._starts_at
        start_error = min(max(error, HIGH_TIME), MAX_START_ERROR)
        self.ledger.sent(
            admitted.token, admitted.layers, now, starts=self._starts_at, error=start_error
        )

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
        self._sets.expire_check()
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
        if ledger is not None and message.ends_playback:
            ledger.note_ended(_RAMP.from_wire(values["ramp"]), sent_at, now)
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
            self.contradictions.compare(
                status,
                sent_at,
                now,
                is_fed=message.feeds,
                ledger=ledger,
                feeding=self.feeding,
                clock=self.clock,
            )

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

    def wire_ramp(self, ramp: float) -> int:
        """Return the nearest ramp [s] that the amplifier can play, in units of the wire.

        Any number is accepted, since silence must never be refused for its ramp.
        """
        if math.isnan(ramp):
            return _RAMP.to_wire(STOP_RAMP)
        wire_ramp = _RAMP.to_wire(min(max(ramp, 0.0), _RAMP.high))
        if not self.identification.is_complete:
            return wire_ramp
        ramp_max: int = self.capabilities["ramp_max"]
        return min(wire_ramp, ramp_max)

    def is_silent(self, status: Values) -> bool:
        """Whether a status shows the levels of all channels, all zero."""
        if not self.identification.is_complete:
            return False
        levels = status["levels"]
        return len(levels) == self.capabilities["channels"] and not any(levels)

    def what_may_play(self, cause: str = "", stop: PendingStop | None = None) -> StopOutcome:
        """Return what it may still play: the only place where that is decided.

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

    def check_other_host(self) -> None:
        """Raise LinkError if another host was heard within the longest time of a watchdog."""
        self.identification.check_other_host(self._time())

    def _confirm(self, token: int, now: float) -> None:
        """Note that the amplifier has reported the set with this token as the one it plays."""
        self.committed = token
        if self._ledger is not None:
            self._ledger.resolve(token, now)
        self._sets.note_committed(token)

    def go_on_from(self, earlier: "Amplifier") -> None:
        """Adopt the state of the same amplifier from before its line was reopened."""
        until = earlier.what_may_play().may_play_until
        self.playback_bound = PlaybackBound(until, earlier.playback_bound.is_stopped)
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
        identification = self.identification
        identification.expect_one()
        try:
            identity = await self.request("Hello", {}, Priority.OTHER, timeout=timeout)
            await asyncio.sleep(SECOND_REPLY)
        except LinkTimeout:
            identification.check_alone()
            raise
        identification.check_alone()
        identification.check_identity(identity)
        can = await self.request("GetCaps", {}, Priority.OTHER, timeout=timeout)
        identification.check_capabilities(can)
        if self._ledger is None:
            self._ledger = Ledger(self.limits, can)
        elif not identification.has_same(can):
            self._ledger.adopt(can)
        identification.complete(identity, can)
        self.exchange_time = cache(self._exchange_time)
        status_words = reply_words("GetStatus", can["channels"], can["layers"])
        self.clock.identified(can["clock_error"], bits=self.line.wire.transit(status_words))
        self.latch = None
        return await self.read_status()

    def arm(self, session: int, watchdog: float = WATCHDOG) -> Coroutine[Any, Any, Values]:
        """Switch the high voltage on at level zero, and return the status; watchdog [s].

        Identifies the amplifier again, because it may have lost power and returned with other
        limits. A stop or disarm that comes after this call goes first, even before it is awaited.
        """
        self._disarms_before_arm = self.disarms_sent
        self._arms_until = threads.now() + _ARM_WITHIN
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
        self.contradictions.restart(status["latch"])
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
            self.contradictions.note_achieved(None)
            self.ledger.correct(layer, achieved, token)
            return achieved
        _, quantity, must, got = problem
        self.contradictions.note_achieved(
            f"{quantity} in layer {layer.layer} must be {must}, got {got}"
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
            await asyncio.sleep(CONFIRM_INTERVAL)
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
        last_disarms_sent = self.disarms_sent
        last_latch = self.latch
        status = await self.identify(timeout=REPLY_TIMEOUT)
        has_restarted = last_latch is None or is_newer_token(last_latch, status["latch"])
        latch = status["latch"] if has_restarted else last_latch
        if self.disarms_sent != last_disarms_sent:
            raise Preempted(f"amplifier {self.name}: a stop or disarm came first")
        self.playback_bound.note_cleared()
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
        if stop is None or stop.is_sent or stop.outcome.done():
            members = len(self.line.members)
            wire_ramp = self.wire_ramp(ramp)
            # On a shared line each amplifier has three exchanges: a stop and two statuses.
            timeout += ATTEMPTS * members * self.exchange_time("GetStatus")
            timeout += _RAMP.from_wire(wire_ramp)
            ends_at = threads.now() + timeout * (members + 1)  # others may keep the line busy
            stop = PendingStop(self, wire_ramp, timeout, ends_at)
            self._stop = stop
            stop.outcome = asyncio.ensure_future(self._outcome_of(stop))
            with contextlib.suppress(Exception):  # then `PendingStop.repeat` makes the request
                stop.queue()
        return asyncio.shield(stop.outcome)

    async def _outcome_of(self, stop: PendingStop) -> StopOutcome:
        """Repeat a stop until it is confirmed or has failed, and return what may play then."""
        cause = await stop.repeat()
        if stop.is_confirmed:
            self.playback_bound.note_stopped(threads.now())
        return self.what_may_play(cause, stop)

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
                raise driven_by_another(self.name)
            left = status["watchdog_left"]


def _disarmed(name: str, status: Values) -> CommandRefused:
    """Return the error of a request that needs an armed amplifier, if a status shows another state.

    name: of the amplifier.
    """
    return CommandRefused(
        f"amplifier {name} is not armed but in {name_of(STATES, status['state'])}, fault "
        f"{name_of(FAULTS, status['fault'])}; once the cause is gone, clear and arm again",
        is_disarmed=True,
    )
