"""Rules for what a host sends: allowed requests, tokens, limits, heartbeats and stops.

Each frame is checked as it passes; what must follow has a deadline, which the delays of the witness
itself defer. The amplifier is modelled from what passes on its wire
(`era_haptics.lab.expected_amplifier`), where replies may be lost: a request without a reply may
have been carried out, which the next status shows.
"""

import math
from collections import deque
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import pairwise

from drivers.playing import Playback
from drivers.protocol.definition import LATCHED, QUANTITIES, REACTION, REFUSALS, STATUS, name_of
from drivers.protocol.records import Values
from drivers.protocol.sets import Command, LayerSet, is_newer_token, is_vibrating
from era_haptics.lab.expected_amplifier import OFF, ExpectedAmplifier
from era_haptics.lab.expected_output import Interval, silent
from witness.capture import (
    CHANGING,
    FEEDING,
    REPLIES,
    AmplifierConfig,
    ReportViolation,
    TimeLimits,
    WitnessedRequest,
    is_carried_out,
)

_LEFT = 0.011  # s; tolerance of the reported time left of the watchdog, as that of a host


class WatchedAmplifier(ExpectedAmplifier):
    """The expected state of one amplifier by name; times [s].

    report_always: for violations that no fault of the wire excuses; report: for all others.
    is_answered: it has said in a reply that it is in a fault; last_fault: when that came;
    reported_at: when it showed a state other than before. unanswered: requests that have no
    reply, and may have been carried out.
    """

    def __init__(
        self,
        name: str,
        *,
        slack: float,
        report: ReportViolation,
        report_always: ReportViolation,
    ) -> None:
        self._name = name
        always, excused = partial(self._say, report_always), partial(self._say, report)
        super().__init__(excused, always, slack=slack, left_slack=_LEFT)
        self.last_fault = -math.inf
        self.is_answered = True
        self.reported_at = -math.inf
        self._answered = 0  # number of the newest request of which a reply was seen
        self._requested = 0  # statuses since the last that was heard
        self._fed_before = math.inf
        # Silence where there must be none, which an unreported fault would explain.
        self._suspicions: list[tuple[str, float, str, object, object]] = []

    def _say(
        self, report: ReportViolation, rule: str, time: float, what: str, *, must: object,
        seen: object,
    ) -> None:  # fmt: skip
        report(rule, time, f"{self._name}: {what} must be {must}, got {seen}")

    def report_silence(
        self, rule: str, time: float, what: str, *, must: object, seen: object
    ) -> None:
        """Note silence that is no violation if it has a fault, as its next status says."""
        self._suspicions.append((rule, time, what, must, seen))

    def forget(self, cause: str = "what was not heard") -> None:
        """Treat all as unknown until the next status."""
        super().forget(cause)
        self.unanswered: list[WitnessedRequest] = []

    def restarted(self, time: float) -> None:
        """Note a restart: disarmed and silent."""
        self.forget()
        self.state, self.token, self.last_status = OFF, 0, time
        self._settle("a restart", (time, time))

    def advance(self, time: float) -> None:
        """Apply what must have happened without a request until now."""
        if not self.unanswered:
            super().advance(time)

    def _trip(self, fault: int, since: Interval, cause: str) -> None:
        super()._trip(fault, since, cause)
        self.is_answered, self.last_fault = False, since[1]

    # requests

    def set_sent(self, request: WitnessedRequest) -> str:
        """Note a part of a set that is sent; returns what is wrong with it, or ""."""
        part = request.values
        if part["index"] >= part["parts"]:
            return f"index must be below {part['parts']}, got {part['index']}"
        if not request.has_reply:
            self.part_came(part, (request.started_at, request.since + REACTION))
            return ""
        return self.sets.sent(part)

    def part_came(self, part: Values, when: Interval) -> None:
        """Apply a part of a set but the last, which may be lost, and then feeds nothing."""
        fed = self.fed
        super().part_came(part, when)
        self.fed = fed

    def sent(self, request: WitnessedRequest) -> None:
        """Note a request without a reply, or none yet, that may be carried out soon."""
        if request.name in FEEDING:
            self._fed_before = self.fed[1]
            self.fed = self.fed[0], max(self.fed[1], request.started_at + REACTION)
        if request.name == "Mark" and request.key is None:
            self.clock.mark((request.started_at, request.since + REACTION))
        self._requested += REPLIES.get(request.name) is STATUS and request.key is not None
        if request.name in CHANGING and request.has_reply:
            self.unanswered.append(request)

    def replied(self, request: WitnessedRequest, values: Values, end: float) -> None:
        """Apply a request carried out until a time [s], and compare its reply.

        A reply that the wire delayed beyond that of a newer request says nothing of now.
        """
        if request.number < self._answered:
            return
        self._answered = request.number
        name = request.name
        self.advance(request.earliest)
        if REPLIES.get(name) is STATUS:
            if self._requested > 1:
                self.clock.unheard()
            self._requested = 0
            self._resolve(request.number, values, end)
        elif name in ("GetAchieved", "GetFaults") and self.unanswered:
            return
        self.granted(name, request.values, values, (request.earliest, end))

    def refused(self, request: WitnessedRequest, code: int, time: float) -> None:
        """Note a refusal; what silences must not be refused, nor a commit of what is staged."""
        if request.problem:  # which must be refused
            return
        if request.name == "Set":
            self.part_refused(request.values, name_of(REFUSALS, code))
        if request.name in FEEDING:
            self.fed = self.fed[0], self._fed_before
        if request.name in ("Stop", "Disarm"):
            self.report("stop", time, f"answer to {request.name}", must="a status", seen="a Nak")
        until, _ = self.sets.staged_until(request.values.get("token"))
        is_held = self.is_enabled and request.values.get("session") == self.session
        if request.name == "Commit" and is_held and time + REACTION <= until:
            self.report(
                "commit",
                time,
                f"answer to Commit of set {request.values['token']}, which is staged",
                must="a status",
                seen="a Nak",
            )

    def _resolve(self, number: int, status: Values, end: float) -> None:
        """Apply earlier requests without a reply that were carried out by a status."""
        earlier = [each for each in self.unanswered if each.number < number]
        self.unanswered = [each for each in self.unanswered if each.number >= number]
        for request in earlier if self.state is not None else ():
            started_at, is_broadcast = request.started_at, request.key is None
            until, _ = self.sets.staged_until(request.values.get("token"))
            match request.name:
                case _ if is_carried_out(request, status):
                    last = min(end, started_at + REACTION) if is_broadcast else end
                    when = started_at, max(last, started_at)
                    self.carry_out(request.name, request.values, status, when)
                case "Arm":
                    self.token = None  # 0, if it was carried out before what disarmed again
                case "Stop" if is_broadcast:
                    self.report(
                        "stop", end, "answer to a broadcast Stop", must="obeyed", seen="none"
                    )
                case _ if is_broadcast and started_at + REACTION <= until:
                    self.report(
                        "commit",
                        end,
                        f"answer to a broadcast Commit of set {request.values['token']}",
                        must="obeyed",
                        seen="none",
                    )

    # reports

    def note_state(self, shown: Values, when: Interval) -> bool:
        """Compare state, fault and latch, and go on with them; returns whether the state fits."""
        before = self.state, self.is_shown
        fits = super().note_state(shown, when)
        if before != (shown["state"], True):
            self.reported_at = when[1]
        for rule, time, what, must, seen in () if self.is_in_fault else self._suspicions:
            self.report(rule, time, what, must=must, seen=seen)
        self._suspicions.clear()
        return fits

    def check(self, shown: Values, when: Interval) -> None:
        """Compare a status that was true at some time between two."""
        super().check(shown, when)
        self.is_answered = True

    def event_reported(self, event: Values, time: float) -> None:
        """Compare an Event, unless a request that explains it is not replied to yet."""
        if self.unanswered:
            return
        self.advance(time)
        if not self.note_state(event, (time, time)):
            self._adopt(event, (time, time))
        self.last_status = time


_TOKENS_KEPT = 16  # of commits


@dataclass
class AmplifierSession:
    """Requests to one amplifier by name, and the model of it; times [s].

    report_always: for violations that no fault of the wire excuses; report: for all others.
    is_disturbed: whether what passed on the wire shortly before a time may have been lost. played:
    what it was sent to play; last_set: sent since Arm, token and layers; staged: the same, unless
    it was silenced since.
    """

    name: str
    config: AmplifierConfig
    amplifier: WatchedAmplifier
    report_always: ReportViolation
    report: ReportViolation
    is_disturbed: Callable[[float], bool]
    played: Playback = field(default_factory=silent)
    last_set: tuple[int, Sequence[LayerSet]] | None = None
    staged: tuple[int, Sequence[LayerSet]] | None = None
    session: int | None = None  # with which the host has armed it
    last_silenced: float = -math.inf  # when a silencing request was sent
    committed_tokens: deque[int] = field(default_factory=lambda: deque(maxlen=_TOKENS_KEPT))
    is_identified: bool | None = None
    is_open: bool = True
    is_stopped: bool = False
    is_requested: bool = False  # whether it is latched, by a host that has opened the wire since
    armed_at: float = -math.inf
    first_stop: float | None = None  # that is not confirmed yet
    is_disarming: bool = False  # until it has shown silence
    last_stop: float = -math.inf  # or status read
    last_feed: float | None = None
    heard_other_host: float = -math.inf
    overdue_at: float = -math.inf  # when a reply was last overdue
    is_mute: bool = False  # it has restarted, and replies to nothing until it is identified
    constants: dict[str, Values] = field(default_factory=dict)

    def vibrates(self, time: float) -> bool:
        """Whether it vibrates at a time by what was sent until now."""
        self.played.advance(time)
        return any(self.played.end_of(layer) > time for layer in self.played.tokens)

    def silence_sent(self, time: float) -> None:
        """Note a request that silences all layers and drops what is staged."""
        self.played = silent()
        self.last_silenced, self.staged = time, None

    def forget_amplifier(self) -> None:
        """Take it for another one from now on, or for one that has started."""
        self.amplifier.forget()
        self.constants.clear()
        self.played = silent()

    def check_constant(self, what: str, reported: Values, time: float) -> None:
        """Compare what must be the same for ever with what was reported before."""
        if reported != self.constants.setdefault(what, reported):
            self.report("constant", time, f"{self.name}: reply to {what} has changed")
        self.constants[what] = reported


_DELAYS_KEPT = 64
_MAX_DEFER = 0.1  # s; before a deadline, within which delays defer it

Expected = tuple[str, AmplifierSession, Callable[[], bool]]
"""A rule, of which amplifier, and whether it is kept at a time."""


class RuleDeadlines:
    """Rules for a host, each to be kept by a time [s]; delays of this program defer it."""

    def __init__(self) -> None:
        self._delays: deque[tuple[float, float]] = deque(maxlen=_DELAYS_KEPT)
        self._pending: list[tuple[float, Expected, str]] = []

    def delayed(self, until: float, duration: float) -> None:
        """Note that nothing was seen for a duration [s] until a time [s]."""
        self._delays.append((until, duration))

    def delay_since(self, time: float) -> float:
        """Sum of the delays [s] that ended after a time [s]."""
        return sum(duration for until, duration in self._delays if until >= time)

    def expect(self, since: float, limit: float, expected: Expected, what: str) -> None:
        """Expect a rule to be kept within a limit [s] of a time; what: to say where it is not."""
        what = f"{what} within {limit * 1e3:g} ms"
        self._pending.append((since + limit, expected, what))

    def advance(self, time: float) -> None:
        """Check the deadlines that have passed, but for those of a disturbed wire."""
        pending, self._pending = self._pending, []
        for due, expected, what in pending:
            rule, session, is_kept = expected
            if due + self.delay_since(due - _MAX_DEFER) >= time:
                self._pending.append((due, expected, what))
            elif not (session.is_disturbed(due) or is_kept()):
                session.report_always(rule, due, what)


_STEP = 0.6  # of a step of the wire; tolerance of rounding
_FRACTIONS = 16  # of a transition at which sums are looked at
_ABOVE = 1.01  # of a sum; what it may exceed a limit by, for moments that are not known
_FREQUENCY, _LEVEL = QUANTITIES["frequency"], QUANTITIES["level"]


def check_set(
    session: AmplifierSession, time: float, token: int, layers: Sequence[LayerSet]
) -> None:
    """Check token and limits of a set that is sent."""
    last = session.last_set or (0, ())
    session.staged = session.last_set = (token, layers)
    is_same = session.staged == last
    if last[0] and not is_same and not is_newer_token(token, last[0]):
        other = " with other contents" if token == last[0] else ""
        session.report_always(
            "token", time, f"set {token} sent to {session.name} after set {last[0]}{other}"
        )
    count = session.amplifier.can.get("layers", math.inf)
    for one in layers:
        if one.layer >= count:
            session.report_always(
                "limits", time, f"set {token}: {session.name} has no layer {one.layer}"
            )
        for command in one.commands:
            if command.is_driven and (problem := _problem_of(session, command)):
                session.report_always(
                    "limits", time, f"channel {command.channel} of {session.name}: {problem}"
                )


def _problem_of(session: AmplifierSession, command: Command) -> str:
    """Describe which limit of its channel a command breaks; "" for none."""
    limits = session.config.channels.get(command.channel)
    if limits is None:
        return "no such channel"
    frequency, (low, high) = _FREQUENCY.from_wire(command.frequency), limits.frequency
    if not low - _FREQUENCY.step * _STEP <= frequency <= high + _FREQUENCY.step * _STEP:
        return f"frequency must be {low:g} to {high:g} Hz, got {frequency:g}"
    shapes = [shape for shape in (command.onset, command.ending) if shape is not None]
    level = max(command.level, *(level for shape in shapes for level, _ in shape.knots), 0)
    if _LEVEL.from_wire(level) > limits.level + _LEVEL.step * _STEP:
        return f"level must be at most {limits.level:g}, got {_LEVEL.from_wire(level):g}"
    return ""


def check_sums(session: AmplifierSession, time: float) -> None:
    """Check what an amplifier plays from a time on, over all layers."""
    sums = _sums(session.amplifier.to_play, time)
    for channel, limits in session.config.channels.items():
        level, rise = sums.get(channel, (0.0, 0.0))
        for what, value, limit in (("level", level, limits.level), ("rise", rise, limits.slew)):
            if value > limit * _ABOVE + _LEVEL.step:
                session.report_always(
                    "limits",
                    time,
                    f"{session.name}: {what} of channel {channel}, sum of all layers, must be at "
                    f"most {limit:g}, got {value:.4g}",
                )


def _sums(playback: Playback, time: float) -> Mapping[int, tuple[float, float]]:
    """Return the largest level and the steepest rise that follow from a time on, by channel.

    In full levels and full levels/s; looked at along the transitions under way.
    """
    times = {time}
    playing = {each: one for each, one in enumerate(playback.all_voices) if one}
    for way in [voice.transition for voices in playing.values() for voice in voices]:
        count = max(_FRACTIONS, len(way.knots) + 1)
        steps = range(count + 1)
        times.update(way.start + (way.end - way.start) * part / count for part in steps)
    moments = sorted({round(at, 6) for at in times if at >= time})  # no sums of floats
    sums: dict[int, tuple[float, float]] = {}
    for channel, voices in playing.items():
        row = [sum(abs(each.transition.at(at)) for each in voices) for at in moments]
        steeps = zip(pairwise(row), pairwise(moments), strict=True)
        sums[channel] = max(row), max(((b - a) / (t - s) for (a, b), (s, t) in steeps), default=0.0)
    return sums


IN_FLIGHT = 0.003  # s; from the host's write until a frame is seen, of Modbus RTU at its end
_IN_TRANSPORT = 0.010  # s; bytes may wait before they pass, while their host counts from its write
_OTHER_HOST = 2.0  # s; for which a host that hears another one sends nothing that plays or feeds
_ATTEMPTS = 3  # of a request that has no reply
_REPEATED = 0.1  # s; within which a stop that is not confirmed goes on, for each amplifier
CONFIRMED = 0.3  # s; then the host says that it is not
_READINGS = ("GetStatus", "GetMeasured")
SILENCING_REQUESTS = ("Stop", "Disarm", "Silence")


class HostRules:
    """The rules for hosts by what passes on the wires, over all amplifiers by name."""

    def __init__(
        self,
        sessions: Mapping[str, AmplifierSession],
        *,
        times: TimeLimits,
        deadlines: RuleDeadlines,
    ) -> None:
        self._sessions = sessions
        self._deadlines = deadlines
        self._times = times

    def advance(self, time: float) -> None:
        """Check the deadlines and heartbeats that are due by now."""
        self._deadlines.advance(time)
        for session in self._sessions.values():
            self._check_heartbeat(session, time)

    # frames

    def is_preempting(
        self, session: AmplifierSession, time: float, request: WitnessedRequest
    ) -> bool:
        """Whether a request may come before a reply that is pending on its wire.

        It silences, or reads whether a stop has, also one that a disarm's reading has confirmed.
        """
        if request.name == "Set" and request.has_reply:
            layers = session.amplifier.sets.whole(request.values["token"])
            return layers is not None and not is_vibrating(*layers)
        is_unconfirmed = session.is_disarming or session.first_stop is not None
        return request.name in SILENCING_REQUESTS or (
            request.name == "GetStatus" and is_unconfirmed
        )

    def check_order(
        self,
        session: AmplifierSession,
        request: WitnessedRequest,
        pending: Collection[WitnessedRequest],
        preempted_by: int,
    ) -> None:
        """Check that no reply is pending that a request must wait for.

        preempted_by: number of the last request before which others may lose their replies. A
        reading is given up once its reply, which begins within 10 ms, is due no more.
        """
        for each in pending:
            waits = request.started_at - each.started_at
            is_preempted = each.number < preempted_by
            # The host counts from its write: the bytes may have waited in a transport since.
            is_given_up = waits >= self._times.reply - max(self._times.slack, _IN_TRANSPORT)
            if each.name in _READINGS:
                each.is_given_up |= request.started_at >= each.since + REACTION - IN_FLIGHT
                is_given_up = each.is_given_up
            if not (is_preempted or is_given_up):
                session.report_always(
                    "credit",
                    request.started_at,
                    f"host sent {request.name} to {session.name} {waits * 1e3:.1f} ms after "
                    f"{each.name}, whose reply is pending",
                )

    def check_request(
        self, session: AmplifierSession, time: float, request: WitnessedRequest
    ) -> None:
        """Check a request to one amplifier; a broadcast is checked for each."""
        layers: Sequence[LayerSet] | None = None
        match request.name:
            case "Set" if request.has_reply:
                layers = session.amplifier.sets.whole(request.values["token"])
            case "Commit" if session.staged is not None:
                token, staged = session.staged
                layers = staged if token == request.values["token"] else None
        if request.name in FEEDING:
            self._check_feeding(session, time, request)
        if request.name == "Arm":
            self._check_arm(session, time)
        if request.name == "Set" and layers is not None:
            check_set(session, time, request.values["token"], layers)
            if is_vibrating(*layers):
                self._check_vibrating(session, time, layers)
        self._remember(session, time, request, layers)

    def request_granted(
        self, session: AmplifierSession, time: float, request: WitnessedRequest
    ) -> None:
        """Note that a request was not refused."""
        match request.name:
            case "Hello":
                session.is_identified = True
            case "Arm":
                was_stopped, session.is_stopped = session.is_stopped, False
                if was_stopped:
                    session.report(
                        "stop", time, f"{session.name} armed before its stop was cleared"
                    )
                session.armed_at = session.last_feed = time
            case "Clear":
                session.is_stopped = False

    def status_heard(self, session: AmplifierSession, values: Values) -> None:
        """Note a status: whether it confirms a stop, or the end of a disarm.

        One that has latched nothing since it was switched on shows that it has restarted after a
        stop that was confirmed, of which there is nothing left to clear. A host that has opened the
        wire since knows a stop by what it shows alone: it may not have heard it.
        """
        may_be_over = session.is_requested or values.get("latch") == 0
        if session.first_stop is None and "state" in values and may_be_over:
            session.is_stopped = session.is_stopped and values["state"] in LATCHED
        if "levels" in values and not any(values["levels"]):
            session.is_disarming = False
            if values["state"] in LATCHED:
                session.first_stop = None

    # rules

    def _check_feeding(
        self, session: AmplifierSession, time: float, request: WitnessedRequest
    ) -> None:
        """Nothing feeds after a stop, or beside another host's session."""
        name = request.name
        if name == "Arm" and session.is_disturbed(time):
            session.is_stopped = False  # the replies to it and to Clear may be lost
        if session.is_stopped and name not in ("Arm", "Silence"):
            session.report_always("stop", time, f"{name} sent after a stop: {session.name}")
        number, at = request.values["session"], session.heard_other_host
        if name in ("Set", "Commit") and session.session not in (None, number):
            session.report_always(
                "session",
                time,
                f"host sent {name} of session {number} to {session.name}, armed with "
                f"{session.session}",
            )
        if time < at + _OTHER_HOST:
            session.report_always(
                "session",
                time,
                f"host sent {name} to {session.name}, driven by another host at {at:.4f} s",
            )
        session.last_feed = time

    def _check_heartbeat(self, session: AmplifierSession, time: float) -> None:
        if session.is_disturbed(time):
            session.last_feed = None  # the host may have given the amplifier up
        last = session.last_feed
        if last is None or not (session.is_open and session.amplifier.is_enabled):
            return
        # The control loop waits for all attempts of a request to any of its amplifiers.
        is_waiting = any(each.overdue_at >= last for each in self._sessions.values())
        longer = self._deadlines.delay_since(last) + is_waiting * _ATTEMPTS * self._times.reply
        if time > last + self._times.heartbeat + self._times.slack + longer:
            session.last_feed = time
            session.report_always(
                "heartbeat", time, f"{session.name}: no heartbeat since {last:.4f} s"
            )

    def _check_arm(self, session: AmplifierSession, time: float) -> None:
        if session.is_identified is False:
            session.report_always(
                "identified", time, f"{session.name} armed without identification"
            )

    def _check_vibrating(
        self, session: AmplifierSession, time: float, layers: Sequence[LayerSet]
    ) -> None:
        """Vibration needs an enabled amplifier, as far as the host can know."""
        amplifier = session.amplifier
        is_disabled = amplifier.state is not None and not amplifier.is_enabled
        # An Event of a fault may cross a set on the wire, which the amplifier then refuses; a set
        # that waits in a queue may still go out with the reply that says so.
        is_known = amplifier.is_answered or not amplifier.is_in_fault
        is_late = time > amplifier.reported_at + IN_FLIGHT
        if is_disabled and is_known and is_late and not session.is_stopped:
            session.report("enabled", time, f"vibration commanded while disabled: {session.name}")

    # state of the session

    def _remember(
        self,
        session: AmplifierSession,
        time: float,
        request: WitnessedRequest,
        layers: Sequence[LayerSet] | None,
    ) -> None:
        name, values = request.name, request.values
        if name in ("Stop", "GetStatus"):
            session.last_stop = time
        if name in SILENCING_REQUESTS:
            session.silence_sent(time)
        match name:
            case "Disarm":
                session.is_disarming = True
            case "Stop":
                is_confirmed = session.is_stopped and session.first_stop is None
                session.is_stopped, session.session, session.is_requested = True, None, False
                if not (is_confirmed and session.amplifier.state in LATCHED):  # else by one before
                    session.first_stop = time if session.first_stop is None else session.first_stop
                    self._expect_confirmation(session, time, session.first_stop)
            case "Arm":
                session.session, session.last_set = values["session"], None
                session.silence_sent(time)
            case "Commit" | "Set" if layers is not None and (name == "Commit" or values["now"]):
                self._note_playing(session, time, values["token"], layers)

    def _note_playing(
        self, session: AmplifierSession, time: float, token: int, layers: Sequence[LayerSet]
    ) -> None:
        is_new = token not in session.committed_tokens
        session.committed_tokens.append(token)
        session.played.commit(layers, token, time)
        if is_new:
            self._expect_commits(session, time, token)
        if not session.vibrates(time):
            session.last_silenced = time

    # deadlines

    def _expect_confirmation(self, session: AmplifierSession, time: float, first: float) -> None:
        """A stop must be confirmed, or go on: it is repeated, or the status is read."""
        wires = [each.config.wire for each in self._sessions.values()]

        def goes_on() -> bool:
            is_over = session.first_stop != first or not session.is_open
            return is_over or session.last_stop > time

        if time <= first + CONFIRMED - _REPEATED:
            self._deadlines.expect(
                time,
                _REPEATED * wires.count(session.config.wire),
                ("stop", session, goes_on),
                f"stop sent to {session.name} at {time:.4f} s, neither confirmed nor repeated",
            )

    def _is_over(self, first: AmplifierSession, time: float) -> bool:
        """Whether no other has to follow a commit of a time [s] any more."""
        is_ended = not first.vibrates(time) or not first.is_open  # by its watchdog
        return is_ended or first.last_silenced >= time  # since then it may play another set

    def _expect_commits(self, first: AmplifierSession, time: float, token: int) -> None:
        """A set that one amplifier plays must be played by all that it was sent to, or silenced."""
        for session in self._sessions.values():
            is_part = session.staged is not None and session.staged[0] == token
            if session is first or not is_part or not session.amplifier.is_enabled:
                continue

            def is_joined(session: AmplifierSession = session) -> bool:
                return token in session.committed_tokens or self._is_over(first, time)

            self._deadlines.expect(
                time,
                self._times.together,
                ("commit", session, is_joined),
                f"set {token} was committed on {first.name} at {time:.4f} s, {session.name} not",
            )
