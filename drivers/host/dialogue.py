"""The exchanges with one amplifier: what it was sent, what it replied, and until when it may play.

`Dialogue` keeps session, latch, status and ledger of the amplifier, and raises CommandRefused once
its replies contradict its requests. `Feeding` counts its watchdog: when it was fed, and when it
must have silenced the amplifier. At the end, the words of the clocks of several amplifiers for one
moment: a steered clock shows the host's time, another one its own, by its readings.
"""

import asyncio
import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, TypeAlias, TypeVar

from drivers.errors import (
    CommandError,
    CommandRefused,
    FrameError,
    LinkDegraded,
    LinkTimeout,
    Overtaken,
    Preempted,
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
from drivers.host.ledger import Ledger
from drivers.host.line import (
    Line,
    LinkStatistics,
    Priority,
    contradicted,
    disarmed,
    driven_by_another,
)
from drivers.playing import AmplifierLayer
from drivers.protocol.definition import (
    AHEAD_MAX,
    ATTEMPTS,
    COMMAND,
    ENABLED,
    ENVELOPE,
    EVENT_RECORD,
    FAST,
    HIGH_TIME,
    HIGH_WORDS,
    KNOT,
    LAYER,
    MAX_AHEAD,
    MESSAGES,
    QUANTITIES,
    REACTION,
    SET_WORDS,
    STATUS,
    STOP_RAMP,
    clock_at,
    high_word,
    moment_of,
    word_passed,
)
from drivers.protocol.records import Values
from drivers.protocol.sets import (
    PART_WORDS,
    LayerSet,
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

SILENCING = 0.005 + REACTION
"""From the expiry of a watchdog until the outputs are silent, at the most [s]."""


@dataclass
class Feeding:
    """When its watchdog was fed, as far as the host knows: what may have, and what surely did.

    delay, is_kept: of the wire; watchdog [s]. may: when [s] the last request that may have fed went
    out. plays: the last such that does not also silence it, arrives: when it arrives unless it is
    delayed: how long the amplifier may play follows from it. fade [s]: longest ramp since, of a
    silence without reply, a stop or a disarm. since, confirmed_at: when the last request that
    surely did went out, and its reply came.
    """

    delay: float = 0.0
    is_kept: bool = False
    watchdog: float = 0.0
    may: float = -math.inf
    plays: float = -math.inf
    arrives: float = -math.inf
    fade: float = 0.0
    since: float = -math.inf
    confirmed_at: float = -math.inf

    @property
    def lost_from(self) -> float:
        """When the watchdog has silenced it, and one that does not reply is lost [s].

        A request without reply may still be under way; what is confirmed came before its reply, and
        not always in the time of the line: a busy machine may have kept it.
        """
        is_confirmed = self.plays <= self.since
        arrival = self.confirmed_at if is_confirmed else self.arrives + self.delay
        return arrival + self.watchdog + self.fade + SILENCING

    @property
    def may_play_until(self) -> float:
        """When the watchdog must have silenced it, even where it is fed once more [s].

        What an adapter has kept comes at any time, all at once: after the watchdog without effect.
        Of several attempts without reply one may have arrived, and the next been kept.
        """
        may_be_fed_again = self.is_kept and self.plays > self.since
        return self.lost_from + (self.watchdog if may_be_fed_again else 0.0)

    def tells(self, sent_at: float) -> bool:
        """Whether a status asked for at a time [s] would show a watchdog that stands still."""
        return self.may <= self.since and sent_at - self.confirmed_at > REACTION

    def problem(self, left: float, sent_at: float, now: float) -> str | None:
        """Describe an impossible time that is left [s] in a reply to a request; None if possible.

        sent_at: of the request, which is not one that feeds; now: of the reply.
        """
        lowest = self.watchdog - (now - self.since) - REACTION
        # One that may have fed and was not confirmed may have come just before this request.
        fed_at = self.confirmed_at if self.may <= self.since else sent_at
        highest = min(self.watchdog, self.watchdog - (sent_at - fed_at)) + REACTION
        if lowest <= left <= highest:
            return None
        return f"watchdog left must be {max(lowest, 0):.3f} to {highest:.3f} s, got {left:.3f} s"


@dataclass(frozen=True, slots=True)
class StopOutcome:
    """What an amplifier may play: confirmed silent, or until when [s] it may play, and why.

    may_play_until: infinite where nothing is known to silence it.
    """

    is_confirmed: bool
    may_play_until: float
    cause: str = ""

    def rows(self, now: float) -> dict[str, Any]:
        """Return it in words at a time [s]: `silence`, `may_play_for_s` and `cause`."""
        left = self.may_play_until - now
        silence = "may_play" if left > 0 else "watchdog_elapsed"
        is_bounded = not self.is_confirmed and left < math.inf
        return {
            "silence": "confirmed_silent" if self.is_confirmed else silence,
            "may_play_for_s": round(max(left, 0.0), 3) if is_bounded else None,
            "cause": self.cause,
        }


UNREACHED = StopOutcome(False, math.inf, "it has not replied since the start")
"""What is known of an amplifier before its first reply."""


MAX_CONTRADICTIONS = 2
"""Contradictions in a row that are a fault; a single one may be a moment between two sets."""
_SAME_MOMENT = 0.01  # s; statuses that are closer show a contradiction once
_RAMP, _WATCHDOG = QUANTITIES["ramp"], QUANTITIES["watchdog"]
_LEFT = QUANTITIES["watchdog_left"]
_SILENCING = ("Stop", "Disarm", "Silence")
_CHANGING = ("Arm", "Disarm", "Stop", "Clear")
_EVENT_WORDS = (
    EVENT_RECORD.words + 7
)  # with a frame of its own, which precedes the reply to what changes the state
_SURELY, _MAX_START_ERROR = 3.0, 0.003  # errors of a clock; s, of a moment by it
COMMITTING = 0.1
"""Time [s] within which a commit arrives and is carried out."""
_CHECKED_FOR = 0.005  # s; for which what was checked holds, unless anything is sent or received
IsPreempted: TypeAlias = Callable[[], bool]
"""Whether what waits preempts a set, as long as no amplifier is to play it."""
_Checked: TypeAlias = tuple[tuple[LayerSet, ...], list[int]]
_UNCHECKED: tuple[Sequence[AmplifierLayer] | None, float, float, _Checked] = (
    None,
    -math.inf,
    0.0,
    ((), []),
)
_logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class StagedSet:
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
        """Empty until it is identified, or while it is not sure who replies: see its ledger."""
        self.session = 0
        self.may_be_armed = False
        """Whether an Arm of this host may have been carried out since it was disarmed."""
        self.latch: int | None = None
        """Newest latch that a status has shown since it was identified."""
        self.status: Values | None = None
        """The last one."""
        self.status_at: float | None = None
        """When [s] it was read."""
        self.arming = (0, -math.inf)
        """Stops and disarms before Arm was requested, and until when [s] it may go out."""
        self.armed_latch: int | None = None
        """That of the reply to the last Arm."""
        self.reported_at: dict[ReportKind, float] = {}
        """When [s] a status had a report last."""
        self.played_at = -math.inf
        """When [s] a set that was sent last starts at the soonest, or silence was sent."""
        self.starts = -math.inf
        """When [s] the set that it has staged starts by its next commit; before now: at once."""
        self._may_wait_until = -math.inf  # s; the last set, by a clock that is not held so well
        self._is_start_known = True  # within what statuses are compared with
        self.committed = 0
        """Token of the set that it committed last, 0 for none since it was armed."""
        self.feeding = Feeding(line.wire.delay, line.wire.is_kept)
        self.known = UNREACHED
        """What it may play by what is known beside its statuses and what fed it."""
        self.clock = HeldClock()
        """Its clock, which is held to that of the line."""
        self.counts = LinkStatistics()
        self.exchange_time = cache(self._exchange_time)  # of the wire, and what was identified
        self.silence_cause: str | None = None
        """Why it is degraded: it did not reply to a request, and may still play."""
        self.listeners: list[Callable[[Values], None]] = []
        self.silences = 0
        """Stops and disarms that were sent to it."""
        self._time = line.time
        self._ledger: Ledger | None = None
        self._admitted: StagedSet | None = None
        self._checked = _UNCHECKED  # what was checked, until when [s], and the outcome
        self._contradictions = self._misachieved = 0  # in a row: statuses, achieved layers
        self._contradicted_at = -math.inf
        self._was_unfed = False  # the status of the last contradiction
        self._other_host_at = -math.inf  # when it was heard last
        self._are_several = False  # two amplifiers have replied since this was reset
        line.members[address] = self

    @property
    def ledger(self) -> Ledger:
        """Its ledger, known once it is identified."""
        if self._ledger is None:
            raise CommandError(f"amplifier {self.name} must be opened first")
        return self._ledger

    @property
    def is_in_doubt(self) -> bool:
        """Whether a set was sent to it that it has not confirmed, so that it may play."""
        return self._ledger is not None and self._ledger.doubt is not None

    def _exchange_time(self, name: str) -> float:
        """Return how long the longest request of a name and its reply take on the wire [s]."""
        can = self.capabilities
        size = (can["channels"], can["layers"]) if can else WIDEST
        event = _EVENT_WORDS if name in _CHANGING else 0
        return self.line.wire.exchange_time(request_words(name), reply_words(name, *size) + event)

    async def stage(
        self,
        token: int,
        layers: Sequence[AmplifierLayer],
        *,
        now: bool = False,
        priority: Priority = Priority.SET,
        is_preempted: IsPreempted | None = None,
    ) -> StagedSet:
        """Stage a set under a token, or play it at once.

        It is admitted by the ledger when its turn on the line has come, unless it is preempted
        then. Raises CommandRefused with the reason; Preempted where a stop came first; FrameError
        for two replies in a row with another token.
        """
        staged: StagedSet

        def make() -> list[Values]:
            nonlocal staged
            if is_preempted is not None and is_preempted():
                raise Overtaken(f"amplifier {self.name}: set {token} is preempted")
            moment, (known, until, delay, checked) = self._time(), self._checked
            if known is not layers or moment > until:
                delay, checked = self._check(layers, moment)
            (admitted, stream), self._checked = checked, _UNCHECKED
            messages = parts(stream, session=self.session, token=token, now=now)
            self._admitted = staged = StagedSet(token, admitted, True, until=moment + delay)
            return messages

        for _ in range(MAX_CONTRADICTIONS):
            taken = await self.line.submit(self, priority, "Set", make)
            if taken["token"] == token:
                break
        else:
            problem = f"a set with token {token} must be taken, got token {taken['token']}"
            # No refusal: all are stopped.
            raise FrameError(str(contradicted(self.name, problem)))
        if not (taken["played"] or (taken["staged"] and not now and self._admitted is staged)):
            raise Preempted(f"amplifier {self.name}: set {token} was not staged")
        return staged if taken["exact"] else replace(staged, is_exact=False)

    def refusal_of(self, layers: Sequence[AmplifierLayer]) -> CommandRefused | None:
        """Return why the ledger would not admit layers now; None if it would.

        They are not checked again if they are staged within 5 ms, nothing sent or received since.
        """
        moment = self._time()
        try:
            delay, checked = self._check(layers, moment, longer=_CHECKED_FOR)
        except CommandRefused as error:
            return error
        self._checked = layers, moment + _CHECKED_FOR, delay, checked
        return None

    def _check(
        self, layers: Sequence[AmplifierLayer], moment: float, *, longer: float = 0.0
    ) -> tuple[float, _Checked]:
        """Return layers as the ledger admits them, and their words; raises CommandRefused.

        With the longest time [s] until they are committed; longer [s]: until they are staged.
        """
        takes = len(self.line.members) * self.exchange_time("Set")
        delay = max(COMMIT_DELAY, ATTEMPTS * takes)
        words = LAYER.words * len(layers)
        for layer in layers:
            words += COMMAND.words * len(layer.tones)
            for tone in layer.tones:
                for shape in (tone.onset, tone.ending):
                    if shape is not None:
                        words += ENVELOPE.words + KNOT.words * len(shape.knots)
        if words > PART_WORDS:  # parts of all of the line, and those again
            delay += 2 * words / PART_WORDS * takes
        admitted = self.ledger.admit(layers, moment, delay=delay + longer)
        stream = pack_layers(admitted)
        if not self.capabilities and is_vibrating(*admitted):
            raise CommandRefused(f"amplifier {self.name} must be identified first; open it again")
        if len(stream) > (limit := self.ledger.capabilities["set_words"]):
            raise CommandRefused(f"a set must have at most {limit} words, got {len(stream)}")
        return delay, (admitted, stream)

    def commit(self, token: int, at: int) -> asyncio.Future[Values]:
        """Play the staged set; the future has the status, which shows its tokens.

        at: high word of its clock when it starts. Or raises Preempted where a stop or disarm came
        first, CommandRefused where it is too late for what the ledger has admitted.
        """
        values = {"session": self.session, "token": token, "at": at}
        return self.line.submit(self, Priority.SET, "Commit", values)

    def next_request(self, name: str, values: Values, priority: Priority) -> float:
        """Return how long a request and its reply take on the wire [s].

        Raises for what plays or feeds, while it must not go out: LinkError while degraded or beside
        another host, CommandRefused once a status has shown that it is not armed any more; of a set
        Preempted once it is not admitted any more, CommandRefused where it is too late.
        """
        takes = self.exchange_time(name)
        if name == "Set" and takes > FAST:  # much shorter, nearly always
            words = SET_WORDS + len(values["stream"])
            takes = self.line.wire.exchange_time(words, reply_words("Set"))
        if name in ("Hello", "Silence") or not MESSAGES[name].feeds:
            return takes
        if name == "Set" or (name == "Commit" and values["token"] != self.committed):
            admitted, token, now = self._admitted, values["token"], self._time()
            if admitted is None or admitted.token != token:
                raise Preempted(f"amplifier {self.name}: a stop, disarm or newer set came first")
            if now > admitted.until and priority is Priority.SET:  # silence is never too late
                raise CommandRefused(
                    f"amplifier {self.name}: set {token} must be committed "
                    f"{now - admitted.until:.3g} s earlier; the wire is too slow or too busy",
                    until=now,
                )
        if name == "Arm":
            silences, until = self.arming
            if self.silences != silences:
                raise Preempted(f"amplifier {self.name}: a stop or disarm came first")
            if self._time() > until:  # this machine slept: it is too late for the caller
                raise LinkTimeout(f"amplifier {self.name}: identified too late; arm again")
        if self._other_host_at > -math.inf:
            self.check_other_host()
        if self.silence_cause is not None:
            raise LinkDegraded(
                f"{self.silence_cause}. The amplifier may play its last set until its watchdog has "
                "passed; nothing new is played until it replies"
            )
        if name != "Arm" and self.status is not None and self.status["state"] != ENABLED:
            raise disarmed(self.name, self.status)
        return takes

    def note_sent(self, name: str, values: Values, now: float, arrives: float) -> None:
        """Note a request that is sent now and may reach it, at a time [s] unless it is delayed."""
        self._checked = _UNCHECKED
        if name != "Set":  # whose reply shows no clock
            # What was sent before may be lost: it may arrive as soon as its own bits have passed.
            self.clock.sent(name, values, now, now + self.line.wire.takes)
        if name == "Hello":
            return
        feeding = self.feeding
        if MESSAGES[name].feeds and (name == "Arm" or values["session"] == self.session):
            if name == "Silence" and self.silence_cause is not None:
                # If it is heard that is within the time of the watchdog, and the ramp follows:
                # repeated without reply, it does not put off when the amplifier must be silent.
                feeding.may = now
                feeding.fade = max(feeding.fade, _RAMP.from_wire(values["ramp"]))
            else:
                feeding.may = feeding.plays = now
                feeding.arrives, feeding.fade = arrives, 0.0
        elif name in ("Stop", "Disarm"):
            feeding.fade = max(feeding.fade, _RAMP.from_wire(values["ramp"]))
            self.silences += 1
        admitted = self._admitted
        if name == "Arm":
            self._admitted, self.may_be_armed = None, True
            self.known = replace(self.known, is_confirmed=False, may_play_until=-math.inf)
        elif name in _SILENCING:
            self._admitted = None
            if name == "Silence" and self._ledger is not None:
                self.played_at = now
                self._ledger.may_be_silent.update(range(self._ledger.capabilities["layers"]))
        elif admitted is not None and values.get("token") == admitted.token and self._ledger:
            is_now = name == "Set" and values["now"] and is_last(values)
            if name == "Commit" or is_now:
                starts = None if is_now or self.starts <= now else self.starts
                self._may_wait_until, error = -math.inf, 0.0
                if not is_now:
                    self._may_wait_until = now + MAX_AHEAD
                    error = abs(self.clock.lead(now)) + _SURELY * self.clock.scatter(now)
                    self._is_start_known = error <= _MAX_START_ERROR
                error = 0.0 if starts is None else min(max(error, HIGH_TIME), _MAX_START_ERROR)
                self.played_at = arrives if starts is None else starts
                self._ledger.sent(admitted.token, admitted.layers, now, starts=starts, error=error)

    def note_reply(self, name: str, values: Values, reply: Values, sent_at: float) -> None:
        """Note the reply to a request that was sent at a time [s].

        Raises CommandRefused once its statuses contradict what was sent, twice in a row.
        """
        now, self._checked = self._time(), _UNCHECKED
        self.counts.last_round_trip = now - sent_at
        message = MESSAGES.get(name)
        if message is None:
            return
        if message.feeds:
            feeding = self.feeding
            feeding.since, feeding.confirmed_at = sent_at, now
            if sent_at > feeding.plays:
                feeding.plays, feeding.fade = sent_at, 0.0
        if message.reply is not STATUS:
            if name == "Set" and reply["played"]:
                self._confirm(values["token"], now)
            return
        if (latch := reply["latch"]) != self.latch and (
            self.latch is None or is_newer_token(latch, self.latch)
        ):
            self.latch = latch
        self.status, self.status_at = reply, now
        # Beside heartbeats a Commit's tells nothing more, unless it may show a Mark, or an end.
        if name != "Commit" or len(self.line.members) > 1 or reply["state"] != ENABLED:
            self.clock.replied(name, values, reply, now)
        for kind in reports_of(reply, self.clock.problem(now)):
            self._note_report(kind, now)
        ledger, is_enabled, fed = self._ledger, reply["state"] == ENABLED, message.feeds
        if ledger is not None and name in _SILENCING:
            ledger.silenced(_RAMP.from_wire(values["ramp"]), sent_at, now)
            self.committed = reply["token"]
            return
        # A set plays some time after its commit: a status of before says that it does, or nothing.
        is_sure = reply["token"] != self.committed or sent_at >= self.played_at + COMMITTING
        if ledger is not None and is_sure:
            self._confirm(reply["token"], now)
        if name == "Ping" and not is_enabled:
            raise disarmed(self.name, reply)
        if ledger is None or not self.session or name in ("Arm", "Clear") or not is_enabled:
            return
        # A status after a request that feeds says nothing of how the watchdog runs down.
        tells = not fed and self.feeding.tells(sent_at)
        problem = armed_problem(reply, self.armed_latch)
        if problem is None and not fed:
            left = reply["watchdog_left"] / _LEFT.per_unit
            problem = self.feeding.problem(left, sent_at, now)
        plays_wrong = None if problem else ledger.problem_of(reply, sent_at, now)
        # By a clock that is not held a set may wait, whatever its commit says.
        if plays_wrong and (
            sent_at >= self._may_wait_until
            or (self._is_start_known and self.clock.error(now) < math.inf)
        ):
            problem = plays_wrong
        if problem is None:
            if tells or not self._was_unfed:
                self._contradictions, self._contradicted_at = 0, -math.inf
            return
        self._was_unfed = not fed
        if now - self._contradicted_at >= _SAME_MOMENT:
            self._contradictions, self._contradicted_at = self._contradictions + 1, now
            if self._contradictions >= MAX_CONTRADICTIONS:
                raise contradicted(self.name, problem)

    def note_unasked(self, arrival: Event | OtherHost | DuplicateAddress) -> None:
        """Note what came without a request; an event is handed on."""
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
        """Note a report of a status, and log it unless the last was a short time ago."""
        if now - self.reported_at.get(kind, -math.inf) > REPORT_LIFE:
            cause, remedy = REPORTS[kind]
            _logger.warning("amplifier %s: %s", self.name, cause, extra={"remedy": remedy})
        self.reported_at[kind] = now

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

    def what_may_play(self, cause: str = "") -> StopOutcome:
        """Return until when it may play by all that is known of it.

        cause: why no more is known, by default what ails its line. Over is what confirmed a stop,
        and was sent neither Clear nor Arm since. Else the watchdog ends what was fed, and what was
        never fed is over once it has shown that it is silent. One that shows more after it was
        confirmed, or its watchdog must have silenced it, is fed by another, or broken. A status
        after the stop alone confirms it.
        """
        status, at, until = self.status, self.status_at, self.known.may_play_until
        if not self.known.is_confirmed:
            until = max(until, self.feeding.may_play_until)
        if status is not None and at is not None:
            is_armed = status["state"] == ENABLED
            if self.is_silent(status) and not is_armed:  # and identified
                until = at if until == math.inf else max(until, at)
            elif (is_armed or any(status["levels"])) and at >= until:
                until = math.inf
        cause = cause or self.line.loss or self.silence_cause or ""
        return StopOutcome(False, math.inf if until == -math.inf else until, cause)

    def check_other_host(self) -> None:
        """Raise LinkError if another host drives it, which must feed within the longest time."""
        if self._time() - self._other_host_at <= _WATCHDOG.high:
            raise driven_by_another(self.name)

    def _confirm(self, token: int, now: float) -> None:
        """Note that the amplifier plays the set with this token, as it says."""
        self.committed = token
        if self._ledger is not None:
            self._ledger.resolve(token, now)
        if self._admitted is not None and self._admitted.token == token:
            self._admitted = None


_Amplifier = TypeVar("_Amplifier", bound=Dialogue)
_STEP = AHEAD_MAX // 2  # from a high word that is tried to the next


def words_of(moment: float, amplifiers: Sequence[_Amplifier]) -> dict[_Amplifier, int]:
    """Return the high words of the clocks of amplifiers at a moment [s], the nearest ones."""
    word = high_word(clock_at(moment + HIGH_TIME / 2))
    return {
        each: word if each.clock.can_be_steered else high_word(clock_at(_shown(each, moment)))
        for each in amplifiers
    }


def word_passed_by_all(now: float, amplifiers: Sequence[Dialogue]) -> int:
    """Return a high word that is no moment ahead for amplifiers, now [s] and a little later."""
    at = word_passed(now)
    others = [each for each in amplifiers if not each.clock.can_be_steered]
    times = [_shown(each, now + later) for each in others for later in (0.0, COMMITTING)]
    for _ in range(HIGH_WORDS // _STEP):
        if all(moment_of(at, time) is None for time in times):
            break
        at = (at - _STEP) % HIGH_WORDS
    return at


def _shown(amplifier: Dialogue, time: float) -> float:
    """Return what the clock of an amplifier shows at a time [s], to the nearest high word."""
    return time + amplifier.clock.lead(time) + HIGH_TIME / 2
