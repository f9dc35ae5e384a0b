"""A model of one amplifier by docs/decisions/0061-protocol-3.md, compared with its replies.

State, fault, tokens, watchdog and levels are known only within the interval between a request and
its reply; reports are compared with all of that interval. A request without a reply may have been
carried out: the next status says so.
"""

import math
from collections.abc import Mapping, Sequence

from drivers.protocol.records import Values
from drivers.protocol.sets import is_newer_token
from drivers.protocol.table import LATCHED, QUANTITIES, REACTION, STAGED_LIFE
from drivers.uncertain_playback import Interval
from sim.witness.capture import ReportViolation
from sim.witness.decoded import (
    CHANGING,
    ENABLED,
    FEEDING,
    REPLIES,
    STATUS_RECORD,
    Request,
    Sent,
    is_carried_out,
)
from sim.witness.expected_outputs import achieved_problem
from sim.witness.expected_state import (
    DISABLED,
    FAULT,
    OFF,
    REACTING,
    SILENCING_RAMP,
    STOPPED,
    SWITCHED_ON,
    ExpectedState,
)

_WARM = QUANTITIES["temperature"].to_wire(60.0)  # from here on an amplifier may derate
_RAMP = QUANTITIES["ramp"]
_ONLY_IN = {**dict.fromkeys(("Set", "Commit", "Silence"), (ENABLED,)), "SetAddress": OFF}
"""States in which alone a request is accepted."""


class ExpectedAmplifier(ExpectedState):
    """The expected state of one amplifier by name; None while it is unknown.

    report_always: for violations that no fault of the wire excuses; report: for all others. token:
    of the set committed last, 0 for none.
    """

    def __init__(
        self,
        name: str,
        *,
        slack: float,
        report: ReportViolation,
        report_always: ReportViolation,
    ) -> None:
        super().__init__(name, slack=slack, report=report)
        self.capabilities: Values = {}
        self.token: int | None = None
        self._report_always = report_always
        self._session: int | None = None
        self._answered = 0  # number of the newest request of which a reply was seen

    def forget_state(self) -> None:
        """Treat the state as unknown until the next status."""
        self.state = self.token = self._session = self._latch = None
        self._fault = 0
        self.unanswered = []
        self.watchdog.fed = (-math.inf, math.inf)
        self.sets.drop()
        self.outputs.forget()

    def restarted(self, time: float) -> None:
        """Note a restart: disarmed and silent."""
        self.forget_state()
        self.state, self.token = DISABLED, 0
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
            self.unanswered.append(sent)

    def granted(self, sent: Sent, values: Values, end: float) -> None:
        """Apply a request carried out until a time [s], and compare its reply.

        A reply that the wire delayed beyond that of a newer request says nothing of now.
        """
        if sent.number < self._answered:
            return
        self._answered = sent.number
        request, when = sent.request, (sent.begin, end)
        status = values if REPLIES.get(request.name) is STATUS_RECORD else None
        self.advance(sent.begin)
        if status is not None:
            self._resolve(sent.number, status, end)
        self._check_allowed(request, end)
        is_late = status is not None and status["state"] in (REACTING, FAULT)
        if request.name in FEEDING and not is_late:  # else it may have expired before
            self.watchdog.fed = when
        if request.name == "Set":
            self._take(request.values, values, when)
        elif request.name == "GetAchieved":
            self._check_achieved(request.values["layer"], values, *when)
        elif request.name == "GetFaults":
            self._check_faults(values, *when)
        elif status is not None:
            self._apply(request, when, status)
            self._status_reported(status, *when, after=request.name)

    def refused(self, request: Request, time: float) -> None:
        """Note a refusal; what silences must not be refused, nor a commit of what is staged."""
        if request.name in FEEDING:
            self.watchdog.undo_feed()
        if request.name in ("Stop", "Disarm"):
            self._report("stop", time, f"refused {request.name}")
        token = request.values.get("token")
        is_held = self.is_enabled and request.values.get("session") == self._session
        if request.name == "Commit" and is_held and self.sets.is_staged(token, time + REACTION):
            self._report("commit", time, f"refused to commit set {token}, which is staged")

    def _resolve(self, number: int, status: Values, end: float) -> None:
        """Apply earlier requests without a reply that were carried out by a status."""
        earlier = [each for each in self.unanswered if each.number < number]
        self.unanswered = [each for each in self.unanswered if each.number >= number]
        for each in earlier if self.state is not None else ():
            request, begun, is_broadcast = each.request, each.begun, each.request.key is None
            token = request.values.get("token")
            if is_carried_out(request, status):
                until = min(end, begun + REACTION) if is_broadcast else end
                self._apply(request, (begun, max(until, begun)), status)
            elif request.name == "Arm":
                self.token = None  # 0, if it was carried out before what disarmed again
            elif is_broadcast and request.name == "Stop":
                self._report("stop", end, "did not obey a broadcast Stop")
            elif is_broadcast and self.sets.is_staged(token, begun + REACTION):
                self._report("commit", end, f"did not obey a broadcast Commit of set {token}")

    def _apply(self, request: Request, when: Interval, status: Values) -> None:
        """Apply a request carried out between two times, by its reply or a later status."""
        values = request.values
        match request.name:
            case "Arm":
                if not self.is_enabled:
                    self._silence(when, SILENCING_RAMP, "Arm")
                    self.token = 0
                self.state, self._fault, self._session = ENABLED, 0, values["session"]
                self._is_reported = True
                self.watchdog.time = QUANTITIES["watchdog"].from_wire(values["watchdog"])
                self.watchdog.fed = when
            case "Disarm" | "Stop":
                self._stopped(request, when)
            case "Silence":
                self._silence(when, _RAMP.from_wire(values["ramp"]), "Silence")
            case "Clear" if self.state in LATCHED and status["state"] in OFF:
                self._cleared(values["latch"], when)
            case "Commit":
                self._committed(values["token"], when)
            case "Set":
                self._play(values["token"], when)

    def _check_allowed(self, request: Request, end: float) -> None:
        """Only the session that is held plays and feeds; nothing plays unless armed."""
        name, session = request.name, request.values.get("session")
        is_foreign = None not in (self._session, session) and session != self._session
        if name in FEEDING and self.is_enabled and is_foreign:
            self._report("session", end, f"accepted {name} of {session}, held by {self._session}")
        before, token = self.token, request.values.get("token", 0)
        if before and token not in (0, before) and not is_newer_token(token, before):
            what = f"{self._name} accepted {name} of set {token} after set {before}"
            self._report_always("token", end, what)
        if self.state not in (None, *_ONLY_IN.get(name, (self.state,))):
            rule = "state" if name == "SetAddress" else "enabled"
            rule = rule if self._is_reported else "watchdog"
            self._report(rule, end, self._in(self.state, f", accepted {name}"))
        if name == "Arm" and self.state in LATCHED and self._is_reported:
            self._report("latched", end, self._in(self.state, ", accepted Arm"))

    def _stopped(self, request: Request, when: Interval) -> None:
        highest = self.capabilities.get("ramp_max", _RAMP.maximum)
        self._silence(when, _RAMP.from_wire(min(request.values["ramp"], highest)), request.name)
        if request.name == "Stop":
            if self.state is None:  # it may have been in a fault before
                self.watchdog.fed = (-math.inf, when[1])
            self.state = self.state if self.is_in_fault else STOPPED
        elif self.is_enabled:
            self.state = SWITCHED_ON

    def _cleared(self, latch: int, when: Interval) -> None:
        if self._latch not in (None, latch):
            self._report("latched", when[1], f"was cleared by latch {latch}, must be {self._latch}")
        # The Event that ends the reaction is not heard while other requests are pending.
        is_reacting = self.state == REACTING and when[0] <= self._last_status + SILENCING_RAMP
        if not (is_reacting and self._is_reported):
            self.state, self._fault = DISABLED, 0
            self.outputs.cause = "Clear"

    def _take(self, part: Values, reply: Values, when: Interval) -> None:
        """Compare the reply to a part of a set, and play a set that is played at once."""
        can, token = self.capabilities, part["token"]
        if reply["token"] != token:
            self._report("credit", when[1], f"replies to set {token} about set {reply['token']}")
            return
        if problem := self.sets.taken(part, reply, when, is_committed=token == self.token):
            self._report("commit", when[1], f"set {token}: {problem}")
        steps = ("frequency_step", "level_step", "phase_step")
        is_fine = not self.outputs.is_warm and all(can.get(each, 1) <= 1 for each in steps)
        if is_fine and (reply["staged"] or reply["played"]) and not reply["exact"]:
            self._report("plays", when[1], f"does not play set {token} exactly")
        if reply["played"]:
            self._play(token, when)

    def _committed(self, token: int, when: Interval) -> None:
        if token == self.token:
            return
        is_known = self.state is not None
        is_staged = self.sets.is_staged(token)
        if is_known and not self.sets.is_staged(token, when[0] - self._slack):
            late = f", staged more than {STAGED_LIFE:g} s before" if is_staged else ", not staged"
            self._report("token", when[1], f"committed set {token}{late}")
        if self.sets.whole(token) is None or not (is_staged or not is_known):
            self.outputs.forget()
            self.token = token
        self._play(token, when)

    def _play(self, token: int, when: Interval) -> None:
        layers = self.sets.whole(token)
        if layers is not None and token != self.token:
            self.token = token
            self.outputs.play(layers, token, when, exact=self.sets.is_exact)
            self.sets.drop()

    # reports

    def _status_reported(self, status: Values, begin: float, end: float, *, after: str) -> None:
        """Compare a status that was true at some time between two [s]; after: which request."""
        self.advance(begin)
        self.outputs.is_warm = status["temperature"] >= _WARM
        state = status["state"]
        self._note_state(state, status["fault"], end)
        self._note_latch(status["latch"], state, end, after=after)
        if self.token not in (None, status["token"]):
            what = f"reports committed set {status['token']}, expected {self.token}"
            self._report("token", end, what)
        self.token = status["token"]
        self._check_left(status["watchdog_left"], state, begin, end)
        may_be_off = self.is_enabled and self.watchdog.may_have_expired(end)
        levels = [QUANTITIES["level"].from_wire(level) for level in status["levels"]]
        self.outputs.check_levels(levels, begin, end, may_be_off=may_be_off)
        if not may_be_off and state == ENABLED:
            self.outputs.check_tokens(status["tokens"], begin, end)
        self.outputs.note_silent(status["tokens"], end)
        self._check_flags(status["flags"], state, begin, end)
        self._last_status, self.is_answered = end, True

    def event_reported(self, event: Values, time: float) -> None:
        """Compare an Event, unless a request that explains it is not replied to yet."""
        if self.unanswered:
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
        if self.unanswered:
            return
        may_be_off = self.is_enabled and self.watchdog.may_have_expired(time)
        of_sensor = self.is_enabled or not self._is_reported  # a fault may have come before
        self.outputs.check_levels(levels, time, time, may_be_off=may_be_off, of_sensor=of_sensor)
        self.outputs.check_frequencies(frequencies, time)

    def _check_achieved(self, layer: int, reply: Values, begin: float, end: float) -> None:
        outputs = self.outputs
        if self.unanswered or not self.is_enabled or not outputs.is_quiet(begin, end):
            return
        expected, token = outputs.playback.playing(layer), outputs.playback.tokens.get(layer, 0)
        can_scale = outputs.is_warm or not outputs.is_exact
        problem = achieved_problem(expected, token, reply, can_scale=can_scale)
        if problem is not None:
            report = self._report if reply["commands"] else outputs.suspect
            report(problem[0], end, f"plays layer {layer}: {problem[1]}")
