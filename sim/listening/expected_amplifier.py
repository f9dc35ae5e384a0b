"""A model of one amplifier by docs/decisions/0061-protocol-3.md, compared with its replies.

State, fault, tokens, watchdog and levels are known only within the interval between a request and
its reply; reports are compared with all of that interval. A request without a reply may have been
carried out: the next status says so.
"""

import math
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass

from drivers.protocol.definition import is_newer_token
from drivers.protocol.records import Values
from drivers.protocol.sets import LayerSet
from drivers.protocol.table import (
    FAULTS,
    MESSAGES,
    QUANTITIES,
    REACTION,
    STAGED_LIFE,
    STATES,
    STATUS_FLAGS,
)
from sim.listening.decoded import CHANGING, FEEDING, STATUS_RECORD, Request
from sim.listening.expected_outputs import ExpectedOutputs, Interval
from sim.listening.set_replies import SetReplies, achieved_problem
from sim.witness.config import TimeLimits
from sim.witness.reports import fault_list_problem
from sim.witness.violation import ReportViolation
from sim.witness.watchdog import Watchdog

SILENCING_RAMP = 0.005  # s; along which the watchdog and faults silence
_WARM = QUANTITIES["temperature"].to_wire(60.0)  # from here on an amplifier may derate
_ENABLED, _STOPPED = STATES["OPERATION_ENABLED"], STATES["QUICK_STOP_ACTIVE"]
_REACTING, _FAULT = STATES["FAULT_REACTION_ACTIVE"], STATES["FAULT"]
_DISABLED, _SWITCHED_ON = STATES["SWITCH_ON_DISABLED"], STATES["SWITCHED_ON"]
_OFF = (STATES["NOT_READY"], _DISABLED, STATES["READY_TO_SWITCH_ON"])
LATCHED = (_STOPPED, _REACTING, _FAULT)
"""States that a stop or a fault leads to, until it is cleared."""
_SPONTANEOUS = {
    _SWITCHED_ON: (_SWITCHED_ON, _DISABLED),
    _REACTING: (_REACTING, _FAULT),
    **dict.fromkeys(_OFF, _OFF),
}
"""States that an amplifier may enter from a state without a request."""
NAMES = {number: name for name, number in STATES.items()}


@dataclass(frozen=True, slots=True)
class Sent:
    """A request as it was sent: in which order, when its first byte passed [s], its reply's key."""

    number: int
    begun: float
    request: Request
    key: Hashable = None


class ExpectedAmplifier:
    """The expected state of one amplifier by name; None while it is unknown.

    report_always: for violations that no fault of the wire excuses; report: for all others.
    """

    def __init__(
        self,
        name: str,
        *,
        times: TimeLimits,
        report: ReportViolation,
        report_always: ReportViolation,
    ) -> None:
        self._name = name
        self._report = report
        self._report_always = report_always
        self._slack = times.slack
        self.state: int | None = None
        self.is_answered = True  # it has told its state in a reply
        self.last_fault = -math.inf  # when it was seen to enter a fault
        self.watchdog = Watchdog(name, slack=times.slack, report=report)
        self.outputs = ExpectedOutputs(name, slack=times.slack, report=report)
        self.sets = SetReplies(name, report=report)
        self.capabilities: Values = {}
        self._fault = 0
        self._is_reported = True  # it has told this state
        self._fault_since: Interval | None = None  # when the present one came, if known
        self._last_status = -math.inf
        self._token: int | None = None
        self._latch: int | None = None
        self._session: int | None = None
        self._unanswered: list[Sent] = []  # and perhaps carried out

    @property
    def token(self) -> int | None:
        """Token of the set committed last, 0 for none."""
        return self._token

    @property
    def is_enabled(self) -> bool:
        """Whether it is armed, as far as is known."""
        return self.state == _ENABLED

    @property
    def is_in_fault(self) -> bool:
        """Whether it is in a fault, or reacting to one."""
        return self.state in (_REACTING, _FAULT)

    def forget_state(self) -> None:
        """Treat the state as unknown until the next status."""
        self.state = self._token = self._session = self._latch = None
        self._fault = 0
        self._unanswered.clear()
        self.watchdog.forget()
        self.sets.drop()
        self.outputs.forget()

    def restarted(self, time: float) -> None:
        """Note a restart: disarmed and silent."""
        self.forget_state()
        self.state, self._token = _DISABLED, 0
        self.outputs.settle("a restart")
        self._last_status = time

    def identified(self, capabilities: Values) -> None:
        """Note its capabilities."""
        self.capabilities = capabilities
        self.outputs.voices = capabilities["voices"]
        if self.outputs.cause in ("nothing", "a restart"):
            self.outputs.settle(self.outputs.cause)

    def advance(self, time: float) -> None:
        """Apply what must have happened without a request until now."""
        if self.state == _ENABLED and self.watchdog.has_expired(time) and not self._unanswered:
            self._silence(self.watchdog.expiry, SILENCING_RAMP, "the watchdog")
            self.state, self._fault, self._is_reported = _REACTING, FAULTS["WATCHDOG"], False
            self.is_answered = False
            self.last_fault, self._fault_since = time, self.watchdog.expiry

    # requests

    def sent(self, sent: Sent) -> None:
        """Note a request without a reply, or none yet, that may be carried out soon."""
        if sent.request.name in FEEDING:
            self.watchdog.may_feed(sent.begun + REACTION)
        if sent.request.name in CHANGING:
            self._unanswered.append(sent)

    def answered(self, sent: Sent) -> None:
        """Note that a request has its reply: a refusal, or what `granted` is given."""
        self._unanswered = [each for each in self._unanswered if each.number != sent.number]

    def granted(self, sent: Sent, values: Values, begin: float, end: float) -> None:
        """Apply a request carried out between two times, and compare its reply."""
        request = sent.request
        record = None if request.name not in MESSAGES else MESSAGES[request.name].reply
        status = values if record is STATUS_RECORD else None
        self.advance(begin)
        if status is not None:
            self._resolve(sent.number, status, end)
        self._check_allowed(request, end)
        is_late = status is not None and status["state"] in (_REACTING, _FAULT)
        if request.name in FEEDING and not is_late:  # else it may have expired before
            self.watchdog.feed((begin, end))
        if request.name == "Set":
            self._take(request.values, values, (begin, end))
        elif request.name == "GetAchieved":
            self._check_achieved(request.values["layer"], values, begin, end)
        elif request.name == "GetFaults":
            self._check_faults(values, begin, end)
        elif status is not None:
            self._apply(request, (begin, end), status)
            self.status_reported(status, begin, end, after=request.name)

    def refused(self, request: Request, time: float) -> None:
        """Note a refusal; what silences must not be refused, nor a commit of what is staged."""
        if request.name in FEEDING:
            self.watchdog.undo_feed()
        if request.name in ("Stop", "Disarm"):
            self._report("stop", time, f"{self._name} refused {request.name}")
        token = request.values.get("token")
        is_held = self.state == _ENABLED and request.values.get("session") == self._session
        if request.name == "Commit" and is_held and self.sets.is_staged(token, time + REACTION):
            self._report("commit", time, f"{self._name} refused to commit set {token}, staged")

    def _resolve(self, number: int, status: Values, end: float) -> None:
        """Apply earlier requests without a reply that were carried out by a status."""
        earlier = [each for each in self._unanswered if each.number < number]
        self._unanswered = [each for each in self._unanswered if each.number >= number]
        for each in earlier if self.state is not None else ():
            name, is_broadcast = each.request.name, each.key is None
            until = min(end, each.begun + REACTION) if is_broadcast else end
            if _is_carried_out(each.request, status):
                self._apply(each.request, (each.begun, max(until, each.begun)), status)
            elif is_broadcast and name == "Stop":
                self._report("stop", end, f"{self._name} did not obey a broadcast Stop")
            elif is_broadcast and name == "Commit":
                token = each.request.values["token"]
                if self.sets.is_staged(token, each.begun + REACTION):
                    what = f"{self._name} did not obey a broadcast Commit of set {token}"
                    self._report("commit", end, what)

    def _apply(self, request: Request, when: Interval, status: Values) -> None:
        """Apply a request carried out between two times, by its reply or a later status."""
        values = request.values
        match request.name:
            case "Arm":
                if self.state != _ENABLED:
                    self._silence(when, SILENCING_RAMP, "Arm")
                    self._token = 0
                self.state, self._fault, self._session = _ENABLED, 0, values["session"]
                self._is_reported = True
                self.watchdog.time = QUANTITIES["watchdog"].from_wire(values["watchdog"])
                self.watchdog.feed(when)
            case "Disarm" | "Stop":
                self._stopped(request, when)
            case "Silence":
                self._silence(when, QUANTITIES["ramp"].from_wire(values["ramp"]), "Silence")
            case "Clear" if self.state in LATCHED:
                self._cleared(values["latch"], status, when)
            case "Commit":
                self._committed(values["token"], when)
            case "Set":
                staged = self.sets.whole(values["token"])
                if staged is not None and values["token"] != self._token:
                    self._play(values["token"], staged, when)

    def _check_allowed(self, request: Request, end: float) -> None:
        """Only the session that is held plays and feeds; nothing plays unless armed."""
        name, session = request.name, request.values.get("session")
        known = None not in (self._session, session)
        if name in FEEDING and self.state == _ENABLED and known and session != self._session:
            what = f"{self._name} accepted {name} of session {session}, held by {self._session}"
            self._report("session", end, what)
        before, token = self._token, request.values.get("token", 0)
        if before and token not in (0, before) and not is_newer_token(token, before):
            what = f"{self._name} accepted {name} of set {token} after set {before}"
            self._report_always("token", end, what)
        if name in ("Set", "Commit", "Silence") and self.state not in (None, _ENABLED):
            rule = "enabled" if self._is_reported else "watchdog"
            self._report(rule, end, f"{self._name} accepted {name} in {self._state_name()}")
        if name == "Arm" and self.state in LATCHED and self._is_reported:
            self._report("latched", end, f"{self._name} accepted Arm in {self._state_name()}")

    def _stopped(self, request: Request, when: Interval) -> None:
        ramp = QUANTITIES["ramp"].from_wire(request.values["ramp"])
        self._silence(when, ramp, request.name)
        if request.name == "Stop":
            if self.state is None:  # it may have been in a fault before
                self.watchdog.feed((-math.inf, when[1]))
            self.state = self.state if self.state in (_REACTING, _FAULT) else _STOPPED
        elif self.state == _ENABLED:
            self.state = _SWITCHED_ON

    def _cleared(self, latch: int, status: Values, when: Interval) -> None:
        """Apply Clear, which leaves the state as it is while the cause lasts."""
        if status["state"] not in _OFF:
            return
        if self._latch not in (None, latch):
            what = f"{self._name} was cleared by latch {latch}, must be {self._latch}"
            self._report("latched", when[1], what)
        # The Event that ends the reaction is not heard while other requests are pending.
        is_reacting = self.state == _REACTING and when[0] <= self._last_status + SILENCING_RAMP
        if not (is_reacting and self._is_reported):
            self.state, self._fault = _DISABLED, 0
            self.outputs.cause = "Clear"

    def _take(self, part: Values, reply: Values, when: Interval) -> None:
        """Compare the reply to a part of a set, and play a set that is played at once."""
        can = self.capabilities
        steps = ("frequency_step", "level_step", "phase_step")
        is_fine = not self.outputs.is_warm and all(can.get(each, 1) <= 1 for each in steps)
        token = part["token"]
        layers = self.sets.taken(
            part, reply, when, is_committed=token == self._token, is_fine=is_fine
        )
        if layers is not None and token != self._token:
            self._play(token, layers, when)

    def _committed(self, token: int, when: Interval) -> None:
        if token == self._token:
            return
        layers = self.sets.whole(token)
        if layers is None or not (self.sets.is_staged(token) or self.state is None):
            if self.state is not None:
                what = f"{self._name} committed set {token}, which is not staged"
                self._report("token", when[1], what)
            self.outputs.forget()
            self._token = token
            return
        if not self.sets.is_staged(token, when[0] - self._slack) and self.state is not None:
            what = f"{self._name} committed set {token}, staged more than {STAGED_LIFE:g} s before"
            self._report("token", when[1], what)
        self._play(token, layers, when)

    def _play(self, token: int, layers: Sequence[LayerSet], when: Interval) -> None:
        self._token = token
        self.outputs.play(layers, token, when, exact=self.sets.is_exact)
        self.sets.drop()

    # reports

    def status_reported(self, status: Values, begin: float, end: float, *, after: str = "") -> None:
        """Compare a status that was true at some time between two [s]; after: which request."""
        self.advance(begin)
        self.outputs.is_warm = status["temperature"] >= _WARM
        state = status["state"]
        self._note_state(state, status["fault"], end)
        self._note_latch(status["latch"], state, end, after=after)
        if self._token not in (None, status["token"]):
            what = f"{self._name} reports committed set {status['token']}, expected {self._token}"
            self._report("token", end, what)
        self._token = status["token"]
        self._check_left(status["watchdog_left"], state, begin, end)
        may_be_off = self.state == _ENABLED and self.watchdog.may_have_expired(end)
        levels = [QUANTITIES["level"].from_wire(level) for level in status["levels"]]
        self.outputs.check_levels(levels, begin, end, may_be_off=may_be_off)
        if not may_be_off and state == _ENABLED:
            self.outputs.check_tokens(status["tokens"], begin, end)
        self.outputs.note_silent(status["tokens"], end)
        is_on = bool(status["flags"] >> STATUS_FLAGS["high_voltage"] & 1)
        must = {_ENABLED: True, _FAULT: False}.get(state, False if state in _OFF else None)
        if must is not None and must != is_on:
            what = f"{self._name} reports high voltage {'on' if is_on else 'off'} in {NAMES[state]}"
            self._report("high_voltage", end, what)
        self._last_status, self.is_answered = end, True

    def event_reported(self, event: Values, time: float) -> None:
        """Compare an Event, unless a request that explains it is not replied to yet."""
        if self._unanswered:
            return
        self.advance(time)
        was_answered = self.is_answered and event["state"] == self.state
        self._note_state(event["state"], event["fault"], time)
        self._note_latch(event["latch"], event["state"], time, after="")
        self._last_status, self.is_answered = time, was_answered

    def check_sensors(
        self, levels: Sequence[float], frequencies: Mapping[int, float], time: float
    ) -> None:
        """Compare what sensors measure on its channels: levels, and known frequencies [Hz]."""
        self.advance(time)
        if self._unanswered:
            return
        may_be_off = self.state == _ENABLED and self.watchdog.may_have_expired(time)
        of_sensor = self.is_enabled
        self.outputs.check_levels(levels, time, time, may_be_off=may_be_off, of_sensor=of_sensor)
        self.outputs.check_frequencies(frequencies, time)

    def _note_state(self, now: int, fault: int, end: float) -> None:
        """Compare a state and a fault with those expected, and go on with them."""
        here = self.state
        if here is None:
            self._adopt(now, fault, end)
            return
        if now in (_REACTING, _FAULT) and here not in (*_OFF, _REACTING, _FAULT):
            self.last_fault = end
            self._check_trip(now, fault, end)
        elif now not in _SPONTANEOUS.get(here, (here,)):
            self._report(self._rule_against(now), end, self._state_problem(now))
        elif self._is_reported and self._fault and fault != self._fault and now in LATCHED:
            what = f"{self._name} reports fault {fault} instead of {self._fault}"
            self._report("latched", end, what)
        self._fault = fault if now in (_REACTING, _FAULT) else 0
        self.outputs.resolve_suspicions(is_enabled=now not in (_REACTING, _FAULT))
        self.state, self._is_reported = now, True

    def _adopt(self, state: int, fault: int, time: float) -> None:
        """Adopt a reported state where it is unknown."""
        self.state, self._fault, self._is_reported = state, fault, True
        self._fault_since = None
        if state in (*_OFF, _FAULT):
            self.outputs.settle(NAMES[state])
        elif state == _ENABLED:
            self.watchdog.feed((-math.inf, time))

    def _check_trip(self, state: int, fault: int, end: float) -> None:
        """Check a transition into a fault: the watchdog not before its time."""
        since = (min(self._last_status, end), end)
        if fault == FAULTS["WATCHDOG"]:
            self.watchdog.check_trip(end)
            since = (min(max(self.watchdog.expiry[0], self._last_status), end), end)
        elif fault == FAULTS["NONE"]:
            self._report("state", end, f"{self._name} is in {NAMES[state]} without a fault")
        self._fault_since = since if since[0] > -math.inf else None
        self._silence((max(since[0], end - 2.0), end), SILENCING_RAMP, "a fault")

    def _note_latch(self, latch: int, state: int, end: float, *, after: str) -> None:
        """Compare the latch: newer after each stop and fault, else as it was."""
        before, self._latch = self._latch, latch
        if before is None:
            return
        is_newer = latch > 0 and is_newer_token(latch, before)
        if after == "Stop" and not is_newer:
            what = f"{self._name} reports latch {latch} after Stop, must be newer than {before}"
            self._report("latched", end, what)
        elif latch != before and not (is_newer and state in LATCHED):
            what = f"{self._name} reports latch {latch} in {NAMES[state]}, must be {before}"
            self._report("latched", end, what)

    def _rule_against(self, now: int) -> str:
        if not self._is_reported:
            return "watchdog" if now == _ENABLED else "latched"
        if now == _ENABLED:
            return "armed"
        return "latched" if self.state in LATCHED else "state"

    def _state_problem(self, now: int) -> str:
        if not self._is_reported and now == _ENABLED:
            return f"{self._name} is still enabled: {self.watchdog}"
        return f"{self._name} must be in {self._state_name()}, got {NAMES[now]}"

    def _check_left(self, left: int, state: int, begin: float, end: float) -> None:
        if state == _ENABLED:
            seconds = QUANTITIES["watchdog_left"].from_wire(left)
            self.watchdog.check_left(seconds, begin, end)
        elif state in _OFF and left:
            self._report("watchdog", end, f"{self._name}: watchdog runs while disarmed")

    def _check_faults(self, values: Values, begin: float, end: float) -> None:
        faults = [(each["fault"], each["age"] / 1000) for each in values["faults"]]
        is_known = self.is_in_fault and self._is_reported and not self._unanswered
        problem = fault_list_problem(
            tuple(faults),
            (begin - self._slack, end + self._slack),
            present=self._fault if is_known else 0,
            since=self._fault_since,
        )
        if problem is not None:
            self._report("faults", end, f"{self._name} {problem}")

    def _check_achieved(self, layer: int, reply: Values, begin: float, end: float) -> None:
        self.outputs.advance(begin - self.outputs.lag)
        if self._unanswered or self.state != _ENABLED or not self.outputs.is_quiet(begin, end):
            return
        outputs = self.outputs
        expected, token = outputs.playback.playing(layer), outputs.playback.tokens.get(layer, 0)
        can_scale = outputs.is_warm or not outputs.is_exact
        found = achieved_problem(expected, token, reply, can_scale=can_scale)
        if found is not None:
            self._report(found[0], end, f"{self._name}: layer {layer}: {found[1]}")

    def _silence(self, when: Interval, ramp: float, cause: str) -> None:
        self.sets.drop()
        self.outputs.silence((max(when[0], -1e9), when[1]), ramp, cause)

    def _state_name(self) -> str:
        return NAMES[self.state] if self.state is not None else "an unknown state"


def _is_carried_out(request: Request, status: Values) -> bool:
    """Whether a later status shows that a request was carried out."""
    match request.name:
        case "Commit":
            return bool(status["token"] == request.values["token"])
        case "Set":
            is_played = status["token"] == request.values["token"]
            return bool(is_played and request.values["now"])
        case "Stop":
            return status["state"] in LATCHED
        case "Disarm":
            return bool(status["state"] != _ENABLED)
        case "Arm":
            return bool(status["state"] == _ENABLED)
        case "Silence":
            return not any(status["tokens"])
        case _:
            return request.name == "Clear"
