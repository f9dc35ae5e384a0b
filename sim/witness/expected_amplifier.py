"""A model of one amplifier by docs/decisions/0061-protocol-3.md, compared with its replies.

State, fault, tokens, watchdog and levels are known only within the interval between a request and
its reply; reports are compared with all of that interval. A request without a reply may have been
carried out: the next status says so.
"""

import math
from collections.abc import Mapping, Sequence

from drivers.protocol.records import Values
from drivers.protocol.sets import LayerSet
from drivers.protocol.table import (
    LATCHED,
    MESSAGES,
    QUANTITIES,
    REACTION,
    STAGED_LIFE,
    STATUS_FLAGS,
)
from drivers.protocol.tokens import is_newer_token
from sim.witness.config import TimeLimits
from sim.witness.decoded import CHANGING, FEEDING, STATUS_RECORD, Request
from sim.witness.expected_outputs import Interval
from sim.witness.expected_state import (
    DISABLED,
    FAULT,
    NAMES,
    OFF,
    REACTING,
    SILENCING_RAMP,
    STOPPED,
    SWITCHED_ON,
    ExpectedState,
)
from sim.witness.set_replies import achieved_problem
from sim.witness.unanswered import ENABLED, Sent, is_carried_out
from sim.witness.violation import ReportViolation

_WARM = QUANTITIES["temperature"].to_wire(60.0)  # from here on an amplifier may derate


class ExpectedAmplifier(ExpectedState):
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
        super().__init__(name, slack=times.slack, report=report)
        self._report_always = report_always
        self.capabilities: Values = {}
        self._token: int | None = None
        self._session: int | None = None

    @property
    def token(self) -> int | None:
        """Token of the set committed last, 0 for none."""
        return self._token

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
        self.state, self._token = DISABLED, 0
        self.outputs.settle("a restart")
        self._last_status = time

    def identified(self, capabilities: Values) -> None:
        """Note its capabilities."""
        self.capabilities = capabilities
        self.outputs.voices = capabilities["voices"]

    # requests

    def sent(self, sent: Sent) -> None:
        """Note a request without a reply, or none yet, that may be carried out soon."""
        if sent.request.name in FEEDING:
            self.watchdog.may_feed(sent.begun + REACTION)
        if sent.request.name in CHANGING:
            self._unanswered.add(sent)

    def answered(self, sent: Sent) -> None:
        """Note that a request has its reply: a refusal, or what `granted` is given."""
        self._unanswered.remove(sent)

    def granted(self, sent: Sent, values: Values, begin: float, end: float) -> None:
        """Apply a request carried out between two times, and compare its reply."""
        request = sent.request
        record = None if request.name not in MESSAGES else MESSAGES[request.name].reply
        status = values if record is STATUS_RECORD else None
        self.advance(begin)
        if status is not None:
            self._resolve(sent.number, status, end)
        self._check_allowed(request, end)
        is_late = status is not None and status["state"] in (REACTING, FAULT)
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
        is_held = self.state == ENABLED and request.values.get("session") == self._session
        if request.name == "Commit" and is_held and self.sets.is_staged(token, time + REACTION):
            self._report("commit", time, f"{self._name} refused to commit set {token}, staged")

    def _resolve(self, number: int, status: Values, end: float) -> None:
        """Apply earlier requests without a reply that were carried out by a status."""
        for each in self._unanswered.take_before(number) if self.state is not None else ():
            name, begun = each.request.name, each.begun
            if is_carried_out(each.request, status):
                until = min(end, begun + REACTION) if each.is_broadcast else end
                self._apply(each.request, (begun, max(until, begun)), status)
            elif each.is_broadcast and name == "Stop":
                self._report("stop", end, f"{self._name} did not obey a broadcast Stop")
            elif each.is_broadcast and name == "Commit":
                token = each.request.values["token"]
                if self.sets.is_staged(token, begun + REACTION):
                    what = f"{self._name} did not obey a broadcast Commit of set {token}"
                    self._report("commit", end, what)

    def _apply(self, request: Request, when: Interval, status: Values) -> None:
        """Apply a request carried out between two times, by its reply or a later status."""
        values = request.values
        match request.name:
            case "Arm":
                if self.state != ENABLED:
                    self._silence(when, SILENCING_RAMP, "Arm")
                    self._token = 0
                self.state, self._fault, self._session = ENABLED, 0, values["session"]
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
        if name in FEEDING and self.state == ENABLED and known and session != self._session:
            what = f"{self._name} accepted {name} of session {session}, held by {self._session}"
            self._report("session", end, what)
        before, token = self._token, request.values.get("token", 0)
        if before and token not in (0, before) and not is_newer_token(token, before):
            what = f"{self._name} accepted {name} of set {token} after set {before}"
            self._report_always("token", end, what)
        if name in ("Set", "Commit", "Silence") and self.state not in (None, ENABLED):
            rule = "enabled" if self._is_reported else "watchdog"
            self._report(rule, end, f"{self._name} accepted {name} in {self._state_name()}")
        if name == "Arm" and self.state in LATCHED and self._is_reported:
            self._report("latched", end, f"{self._name} accepted Arm in {self._state_name()}")

    def _stopped(self, request: Request, when: Interval) -> None:
        highest = self.capabilities.get("ramp_max", QUANTITIES["ramp"].maximum)
        ramp = QUANTITIES["ramp"].from_wire(min(request.values["ramp"], highest))
        self._silence(when, ramp, request.name)
        if request.name == "Stop":
            if self.state is None:  # it may have been in a fault before
                self.watchdog.feed((-math.inf, when[1]))
            self.state = self.state if self.state in (REACTING, FAULT) else STOPPED
        elif self.state == ENABLED:
            self.state = SWITCHED_ON

    def _cleared(self, latch: int, status: Values, when: Interval) -> None:
        """Apply Clear, which leaves the state as it is while the cause lasts."""
        if status["state"] not in OFF:
            return
        if self._latch not in (None, latch):
            what = f"{self._name} was cleared by latch {latch}, must be {self._latch}"
            self._report("latched", when[1], what)
        # The Event that ends the reaction is not heard while other requests are pending.
        is_reacting = self.state == REACTING and when[0] <= self._last_status + SILENCING_RAMP
        if not (is_reacting and self._is_reported):
            self.state, self._fault = DISABLED, 0
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
        may_be_off = self.state == ENABLED and self.watchdog.may_have_expired(end)
        levels = [QUANTITIES["level"].from_wire(level) for level in status["levels"]]
        self.outputs.check_levels(levels, begin, end, may_be_off=may_be_off)
        if not may_be_off and state == ENABLED:
            self.outputs.check_tokens(status["tokens"], begin, end)
        self.outputs.note_silent(status["tokens"], end)
        is_on = bool(status["flags"] >> STATUS_FLAGS["high_voltage"] & 1)
        must = {ENABLED: True, FAULT: False}.get(state, False if state in OFF else None)
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
        may_be_off = self.state == ENABLED and self.watchdog.may_have_expired(time)
        of_sensor = self.is_enabled or not self._is_reported  # a fault may have come before
        self.outputs.check_levels(levels, time, time, may_be_off=may_be_off, of_sensor=of_sensor)
        self.outputs.check_frequencies(frequencies, time)

    def _check_achieved(self, layer: int, reply: Values, begin: float, end: float) -> None:
        self.outputs.advance(begin - self.outputs.lag)
        if self._unanswered or self.state != ENABLED or not self.outputs.is_quiet(begin, end):
            return
        outputs = self.outputs
        expected, token = outputs.playback.playing(layer), outputs.playback.tokens.get(layer, 0)
        can_scale = outputs.is_warm or not outputs.is_exact
        found = achieved_problem(expected, token, reply, can_scale=can_scale)
        if found is None:
            return
        violation = found[0], end, f"{self._name}: layer {layer}: {found[1]}"
        if reply["commands"]:
            self._report(*violation)
        else:
            outputs.suspect(*violation)
