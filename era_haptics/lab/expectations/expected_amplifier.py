"""Expected state of an amplifier after the requests sent to it: states, sessions, sets, outputs.

A request is carried out at some time between sending it and its reply, and a status is true at some
time in between, so both are compared over that whole interval. Nothing is known until the first
status.
"""

import math
from typing import NamedTuple

from drivers.protocol.achieved import FLAGS, TONE, AchievedProblem, achieved_problem
from drivers.protocol.definition import (
    ENABLED,
    FAULTS,
    LATCHED,
    MESSAGES,
    QUANTITIES,
    STATES,
    has_flag,
    name_of,
)
from drivers.protocol.records import Values
from drivers.protocol.sets import LayerSet, is_newer_token, token_after
from era_haptics.lab.expectations.expected_clock import ExpectedClock
from era_haptics.lab.expectations.expected_faults import ExpectedFaults
from era_haptics.lab.expectations.expected_outputs import ExpectedOutputs
from era_haptics.lab.expectations.expected_set import ExpectedSet
from era_haptics.lab.expectations.mismatches import ReportMismatch, ReportUnclear, alternatives
from era_haptics.lab.expectations.tolerances import DRIFT, ROUNDED, UNKNOWN, Interval

OFF = STATES["SWITCH_ON_DISABLED"]
STOPPED = STATES["QUICK_STOP_ACTIVE"]
REACTING = STATES["FAULT_REACTION_ACTIVE"]
FAULT = STATES["FAULT"]
SWITCHED_ON = STATES["SWITCHED_ON"]
DISARMED = STATES["NOT_READY"], OFF, STATES["READY_TO_SWITCH_ON"]
FADE = 0.005
"""Fade after a fault [s]."""
FEEDING = frozenset(name for name, message in MESSAGES.items() if message.feeds)
"""Requests that feed the watchdog unless they are rejected."""

_TRIP = 0.005  # s; from the end of the watchdog time until the watchdog trips
_SETTLING = 0.01  # s; until a state is reported
_STATE_AFTER_FADE = {SWITCHED_ON: OFF, REACTING: FAULT}
_WARM = QUANTITIES["temperature"].to_wire(60.0)  # above this temperature an amplifier can derate
_ONLY_IN = {
    **dict.fromkeys(("Set", "Commit", "Silence"), (ENABLED,)),
    "SetAddress": DISARMED,
    "Arm": (*DISARMED, SWITCHED_ON, ENABLED),
}
"""The only states in which a request is accepted."""
_RULE_OF_STATE = {"Arm": "latched", "SetAddress": "state"}
"""Rules that requests violate in another state; other requests violate the rule `enabled`."""
_INDEPENDENT_OF_CONTENT = "WRONG_SESSION", "WRONG_STATE", "BUSY"
"""Reasons for rejecting a part that do not depend on its content."""


class _WaitingSet(NamedTuple):
    """A committed set that starts in an interval; is_exact: it plays without rounding."""

    start: Interval
    token: int
    layers: tuple[LayerSet, ...]
    is_exact: bool


def request_text(name: str, values: Values) -> str:
    """Return a request with its values, as reasons name it, without the words of a set."""
    fields = [field for field in MESSAGES[name].request.names if field in values]
    texts = [f"{field} {values[field]}" for field in fields if field != "stream"]
    return f"{name} ({', '.join(texts)})" if texts else name


class ExpectedAmplifier:
    """Expected state of an amplifier; times [s]. Unknown state, latch, token and session: None.

    - report: receives violations; always: receives violations that nothing excuses; unclear:
      receives the reason why the state is unknown.
    - may_fail: the amplifier can have faults of its own.
    - slack: tolerance of times; left_slack: tolerance of the watchdog's remaining time.
    - fed: last time the watchdog was fed; silent: when all fades have ended.
    - is_shown: the amplifier has reported its state itself.
    - last_status: start of the interval without observations.
    - can: the amplifier's capabilities.
    """

    def __init__(
        self,
        report: ReportMismatch,
        always: ReportMismatch,
        *,
        unclear: ReportUnclear | None = None,
        may_fail: bool = True,
        slack: float = 0.0,
        left_slack: float = ROUNDED,
    ) -> None:
        self.can: Values = {}
        self.report = report
        self.slack = slack
        self._report_always = always
        self._report_unclear = unclear
        self._may_fail = may_fail
        self._left_slack = left_slack
        self.forget()
        self.last_status = -math.inf

    def forget(self, cause: str = "missed messages") -> None:
        """Treat everything as unknown until the next status."""
        self.token: int | None = None
        self.session: int | None = None
        self.state: int | None = None
        self.fault = FAULTS["NONE"]
        self.latch: int | None = None
        self.sets = ExpectedSet()
        self.clock = ExpectedClock(self.report, self.slack)
        self.watchdog = math.inf
        self.fed = UNKNOWN
        self.silent = UNKNOWN
        self.is_shown = True
        self._waiting: _WaitingSet | None = None
        self._started = -math.inf  # latest start of a waiting set
        self._faults = ExpectedFaults(self.report, self.slack)
        self._settle(cause)
        self.outputs.forget()

    def _settle(self, cause: str, when: Interval = UNKNOWN) -> None:
        """Treat all channels as silent from some time in an interval."""
        self.outputs = ExpectedOutputs(
            self.can,
            report=self.report,
            unclear=self._report_unclear,
            slack=self.slack,
            cause=cause,
            began=when,
        )

    def identified(self, capabilities: Values) -> None:
        """Note its capabilities."""
        if capabilities != self.can:
            self.can = capabilities
            self._settle("missed messages")
            self.outputs.forget()

    def _expect(
        self, rule: str, when: Interval, quantity: str, expected: object, actual: object
    ) -> None:
        """Report a value that differs from the expected one."""
        if expected != actual:
            self.report(rule, when.latest, quantity, expected=expected, actual=actual)

    def _name_of(self, state: int | None) -> str:
        return "unknown" if state is None else name_of(STATES, state)

    @property
    def is_enabled(self) -> bool:
        """Return whether it is armed, as far as is known."""
        return self.state == ENABLED

    @property
    def is_in_fault(self) -> bool:
        """Return whether it is in a fault or reacting to one."""
        return self.state in (REACTING, FAULT)

    @property
    def expiry(self) -> Interval:
        """Return the earliest and latest time at which the watchdog trips if it is not fed."""
        if self.watchdog == math.inf:  # not known
            return UNKNOWN
        min_time = self.watchdog * (1 - DRIFT)
        max_time = (self.watchdog + _TRIP) * (1 + DRIFT)
        return Interval(self.fed.earliest + min_time - ROUNDED, self.fed.latest + max_time)

    # Requests

    def granted(self, name: str, values: Values, reply: Values, when: Interval) -> None:
        """Apply a request carried out in an interval, and compare its reply."""
        self.advance(when.earliest)
        self._check_allowed(name, values, when.latest)
        may_have_expired = reply.get("state") in (REACTING, FAULT)
        if name in FEEDING and self.state in (None, ENABLED) and not may_have_expired:
            self.fed = when
        match name:
            case "Set":
                self._take(values, reply, when)
            case "GetAchieved":
                self._check_achieved(values["layer"], reply, when)
            case "GetFaults":
                self._faults.check(reply["faults"], when)
            case _:
                self.carry_out(name, values, reply, when)
        if "levels" in reply:
            self.check(reply, when)

    def _check_allowed(self, name: str, values: Values, time: float) -> None:
        """Check that only the held session plays and feeds, and that nothing plays unless armed."""
        session = values.get("session")
        token = values.get("token", 0)
        if name in FEEDING and self.is_enabled and self.session not in (None, session):
            quantity = f"session of {name}"
            self.report("session", time, quantity, expected=self.session, actual=session)
        if self.token and token not in (0, self.token) and not is_newer_token(token, self.token):
            expected = f"newer than {self.token}"
            self._report_always("token", time, f"token of {name}", expected=expected, actual=token)
        if self.state not in (None, *_ONLY_IN.get(name, (self.state,))):
            rule = _RULE_OF_STATE.get(name, "enabled") if self.is_shown else "watchdog"
            quantity = f"reply to {name} in {self._name_of(self.state)}"
            self.report(rule, time, quantity, expected="WRONG_STATE", actual="carried out")

    def carry_out(self, name: str, values: Values, status: Values, when: Interval) -> None:
        """Apply a request carried out in an interval; status: its reply, or a later status."""
        ramp = min(values.get("ramp", 0), self.can.get("ramp_max", math.inf)) / 1000
        cause = request_text(name, values)
        if name in ("Stop", "Disarm"):
            self._trip_if_expired(status, when)
        match name:
            case "Arm":
                self._arm(values, when, cause)
            case "Silence":
                self._fall_silent(ENABLED, when, ramp, cause)
            case "Disarm" if self.state is not None:
                state = SWITCHED_ON if self.is_enabled else self.state
                self._fall_silent(state, when, ramp, cause)
            case "Stop" if self.state is not None:
                self._advance_latch()
                state = self.state if self.is_in_fault else STOPPED
                self._fall_silent(state, when, ramp, cause)
            case "Clear" if self.state in LATCHED:
                self._clear(values["latch"], status["state"], when)
            case "Commit":
                self._commit(values, when)
            case "Set" if values["now"]:
                self._play(values["token"], when)
            case "Mark":
                self.clock.mark(when)

    def _trip_if_expired(self, status: Values, when: Interval) -> None:
        """Trip the watchdog before a request if the status shows that it had expired."""
        has_expired = self.is_enabled and status.get("fault") == FAULTS["WATCHDOG"]
        if has_expired and when.latest >= self.expiry.earliest:
            self._trip(FAULTS["WATCHDOG"], self._expired_by(when.latest), "the watchdog")

    def _arm(self, values: Values, when: Interval, cause: str) -> None:
        """Hold a session; a new one begins silent."""
        session = values["session"]
        if not self.is_enabled or session != self.session:
            self._fall_silent(ENABLED, when, FADE, cause, has_floor=False)
            self.token = 0
            self.clock.shifted()
        self.fault = FAULTS["NONE"]
        self.session = session
        self.is_shown = True
        self.watchdog = values["watchdog"] / 1000
        self.fed = when

    def _clear(self, latch: int, state: int, when: Interval) -> None:
        """Leave a stop or a fault once everything is silent, if its cause has gone."""
        is_cause_gone = self.fault in (FAULTS["NONE"], FAULTS["WATCHDOG"])
        is_off = state in DISARMED and when.latest >= self.silent.earliest - ROUNDED
        if is_off and self.latch is not None:
            self._expect("latched", when, "latch of Clear", self.latch, latch)
        if is_off or (is_cause_gone and self._is_silent(when)):
            self.state = OFF
            self.fault = FAULTS["NONE"]
            self.outputs.cause = "Clear"

    def advance(self, time: float) -> None:
        """Apply everything that must have happened without a request until now."""
        if self.is_enabled and time > self.expiry.latest + ROUNDED + self.slack:
            self._trip(FAULTS["WATCHDOG"], self.expiry, "the watchdog")
            self.is_shown = False
        if self._waiting is not None and time > self._waiting.start.latest + self.slack:
            self._start_waiting()

    def _trip(self, fault: int, when: Interval, cause: str) -> None:
        """Fall silent because of a fault."""
        self.fault = fault
        self._advance_latch()
        self._faults.add(fault, when)
        has_floor = fault == FAULTS["WATCHDOG"] and not self._may_fail
        self._fall_silent(REACTING, when, FADE, cause, has_floor=has_floor)

    def _advance_latch(self) -> None:
        self.latch = None if self.latch is None else token_after(self.latch)

    def _fall_silent(
        self, state: int, when: Interval, ramp: float, cause: str, *, has_floor: bool = True
    ) -> None:
        """Enter a state in which all layers fade along a ramp [s]."""
        self.sets.drop()
        if self.may_start(when):  # then the layers that fall silent are unknown
            self.outputs.forget()
        self._waiting = None
        self.state = state
        self.silent = self.outputs.silence(when, ramp, cause, has_floor=has_floor)

    # Sets

    def _take(self, part: Values, reply: Values, when: Interval) -> None:
        """Compare the reply to a part of a set, and play the set if it plays immediately."""
        token = part["token"]
        self._expect("credit", when, "token of a reply to Set", token, reply["token"])
        self._check_exact(token, reply, when)
        if token != reply["token"]:
            return
        expected: tuple[int, int, int] | None = (0, 0, 1)
        if token != self.token:
            expected = self.sets.taken(part, reply, when)
        if expected is not None:
            quantity = f"missing, staged, played after part {part['index']} of set {token}"
            actual = reply["missing"], reply["staged"], reply["played"]
            self._expect("commit", when, quantity, expected, actual)
        elif self._report_unclear is not None:
            self._report_unclear("a part came as its set expired")
        if reply["played"]:
            self._play(token, when)

    def _check_exact(self, token: int, reply: Values, when: Interval) -> None:
        """Compare `exact`: set for a whole set that an amplifier without steps plays."""
        has_fine_steps = all(self.can.get(f"{quantity}_step", 1) <= 1 for quantity in TONE)
        if not (reply["staged"] or reply["played"]):
            self._expect("plays", when, f"exact of set {token}, not whole", 0, reply["exact"])
        elif has_fine_steps and not self.outputs.may_derate:
            self._expect("plays", when, f"exact of set {token}", 1, reply["exact"])

    def part_came(self, part: Values, when: Interval) -> None:
        """Apply a part other than the last, which is kept or dropped without a reply."""
        self.advance(when.earliest)
        is_held = self.state in (None, ENABLED) and self.session in (None, part["session"])
        is_newer = is_newer_token(part["token"], self.token or 0)
        if is_held and is_newer and self.sets.keep(part, when):
            self.fed = when

    def part_refused(self, part: Values, code: str) -> None:
        """Apply the rejection of a set's last part, according to the code."""
        if code not in _INDEPENDENT_OF_CONTENT:
            self.sets.refused(part)

    def _commit(self, commit: Values, when: Interval) -> None:
        """Play the staged set, immediately or from its moment on."""
        token = commit["token"]
        if token == self.token:
            return
        until = self.sets.staged_until(token).latest
        if self.token is not None and until < when.earliest - self.slack:
            actual = f"until {until:.4f} s" if until > -math.inf else "not staged"
            quantity = f"set {token} that is committed"
            self.report("token", when.latest, quantity, expected="staged", actual=actual)
        self._play(token, when, self.clock.moment(commit["at"], when))

    def may_start(self, when: Interval) -> bool:
        """Return whether a set that waits, or has waited, can start within an interval."""
        if self._waiting is not None and when.latest >= self._waiting.start.earliest - self.slack:
            return True
        return when.earliest <= self._started + self.slack

    def _start_waiting(self, replaced: Interval | None = None) -> None:
        """Start the waiting set at its own time, or earlier if another set replaces it."""
        if self._waiting is None:
            return
        start, token, layers, is_exact = self._waiting
        is_immediate = False
        if replaced is not None:
            is_immediate = replaced.earliest < start.latest
            earliest = min(start.earliest, replaced.earliest)
            start = Interval(earliest, min(start.latest, replaced.latest))
        self._waiting = None
        self._started = start.latest
        self.outputs.play(layers, token, start, is_exact=is_exact, is_immediate=is_immediate)

    def _play(self, token: int, when: Interval, moment: Interval | None = None) -> None:
        """Play a set from some time in an interval, or from a given time, unless it is playing."""
        if token == self.token:
            return
        self._start_waiting(when)
        self.token = token
        layers = self.sets.whole(token)
        if layers is None:
            self.outputs.forget()
            return
        if moment is None:
            self.outputs.play(layers, token, when, is_exact=self.sets.is_exact)
        else:
            self._waiting = _WaitingSet(moment, token, layers, self.sets.is_exact)
        self.sets.drop()

    # Statuses

    def check(self, status: Values, when: Interval) -> None:
        """Compare a status that was true at some time in an interval."""
        self.advance(when.earliest)
        self.outputs.may_derate = status["temperature"] >= _WARM
        if not self.note_state(status, when):
            self._adopt(status, when)
            return
        if self.token is not None:
            quantity = f"token after {self.outputs.cause}"
            self._expect("token", when, quantity, self.token, status["token"])
        self.token = status["token"]
        self._check_watchdog_left(status["watchdog_left"] / 1000, when)
        self.clock.check(status["clock"], when)
        if not self.may_start(when):
            self.outputs.check(status, when)
        self._check_voltage(status, when)
        self.last_status = when.earliest

    def _check_watchdog_left(self, remaining: float, when: Interval) -> None:
        """Compare the watchdog's remaining time [s]."""
        low = high = 0.0
        if self.is_enabled:
            if self.watchdog == math.inf:
                return
            slack = self._left_slack + self.slack
            low = self.watchdog - (when.latest - self.fed.earliest) - slack
            high = self.watchdog - (when.earliest - self.fed.latest) + slack
        if not low <= remaining <= max(high, 0.0):
            quantity = f"watchdog_left after {self.outputs.cause}"
            expected = f"{low:.6g} to {high:.6g}"
            self.report("watchdog", when.latest, quantity, expected=expected, actual=remaining)

    def note_state(self, status: Values, when: Interval) -> bool:
        """Compare state, fault and latch, and adopt them; returns whether the state is possible."""
        state = status["state"]
        fault = status["fault"]
        if self.state is None:
            self._adopt(status, when)
        if state in (REACTING, FAULT) and self.state in (ENABLED, SWITCHED_ON, STOPPED):
            self._note_fault(fault, when)
        possible_states = self._possible_states(when)
        cause = self.outputs.cause
        if state not in possible_states:
            quantity = f"state {when.earliest - self.outputs.began.latest:.3f} s after {cause}"
            expected = alternatives(map(self._name_of, possible_states))
            actual = self._name_of(state)
            rule = self._rule_against(state)
            self.report(rule, when.latest, quantity, expected=expected, actual=actual)
            return False
        if fault and fault != self.fault and self._may_fail and not self.is_shown:
            self.fault = fault  # a fault before the watchdog expired that was not observed
            self._faults.correct(fault, Interval(self.last_status, when.latest))
        rule = "latched" if state in LATCHED else "state"
        self._expect(rule, when, f"fault after {cause}", self.fault, fault)
        if self.latch is not None:
            self._expect("latched", when, f"latch after {cause}", self.latch, status["latch"])
        self.state = state
        self.fault = fault
        self.latch = status["latch"]
        self.is_shown = True
        return True

    def _adopt(self, status: Values, when: Interval) -> None:
        """Adopt a status without comparing it."""
        past = Interval(-math.inf, when.latest)
        state = status["state"]
        if state != self.state:
            self.state = state
            self.silent = UNKNOWN
            if state in (*DISARMED, FAULT):
                self._settle(self._name_of(state), when)
                self.silent = past
            elif state == ENABLED:
                self.fed = past
                self.outputs.forget()
            if self.is_in_fault:
                self._faults.add(status["fault"], past)
        self.fault = status["fault"]
        self.latch = status["latch"]
        self.token = status.get("token", self.token)
        self.is_shown = True
        self.last_status = when.earliest

    def _possible_states(self, when: Interval) -> list[int]:
        """Return the states in which the amplifier can be during an interval."""
        state = self.state or STATES["NOT_READY"]
        if state == STATES["NOT_READY"]:
            return [state, OFF]
        if state not in _STATE_AFTER_FADE:
            return [state]
        states = [] if self._is_silent(when) else [state]
        if when.latest > self.silent.earliest - ROUNDED - self.slack:
            states.append(_STATE_AFTER_FADE[state])
        return states

    def _is_silent(self, when: Interval) -> bool:
        """Return whether it must have been silent, and report so, during an interval."""
        return when.earliest > self.silent.latest + _SETTLING + ROUNDED + self.slack

    def _rule_against(self, state: int) -> str:
        """Return the rule that a state violates."""
        if not self.is_shown:
            return "watchdog" if state == ENABLED else "latched"
        if state == ENABLED:
            return "armed"
        return "latched" if self.state in LATCHED else "state"

    def _note_fault(self, fault: int, when: Interval) -> None:
        """Check a transition into a fault: the watchdog must not trip early."""
        fault_time = Interval(min(self.last_status, when.latest), when.latest)
        name = name_of(FAULTS, fault)
        if fault == FAULTS["WATCHDOG"]:
            self._check_trip_time(when)
            fault_time = self._expired_by(when.latest)
        elif fault == FAULTS["NONE"] or not self._may_fail:
            expected = "WATCHDOG" if fault else "one"
            quantity = "fault of a fault reaction"
            self.report("state", when.latest, quantity, expected=expected, actual=name)
        self._trip(fault, fault_time, f"fault {name}")

    def _check_trip_time(self, when: Interval) -> None:
        """Check that the watchdog did not trip early."""
        early, late = self.expiry
        enabled_until = when.latest if self.is_enabled else self.outputs.began.latest
        if enabled_until < early - self.slack:
            quantity = f"time of the watchdog ({self.outputs.cause})"
            expected = f"from {early:.4f} to {late:.4f} s"
            actual = f"{when.latest:.4f} s"
            self.report("watchdog", when.latest, quantity, expected=expected, actual=actual)

    def _expired_by(self, time: float) -> Interval:
        """Return the interval in which the watchdog tripped, if it had tripped by `time`."""
        early, late = self.expiry
        earliest = min(max(early, self.last_status), time)
        return Interval(earliest, max(min(late, time), earliest))

    def _check_voltage(self, status: Values, when: Interval) -> None:
        """Check high voltage, and the interlock if the amplifier has one."""
        has_faded = when.latest >= self.silent.earliest - ROUNDED - self.slack
        is_fading = any(status["levels"]) and not has_faded
        must_be_on = self.state in (ENABLED, SWITCHED_ON) or (self.state == STOPPED and is_fading)
        condition = f"in {self._name_of(self.state)} after {self.outputs.cause}"
        if must_be_on:
            is_open = has_flag(status, "interlock_open")
            self._expect("high_voltage", when, f"interlock_open {condition}", False, is_open)
        if must_be_on or self._is_silent(when):
            is_on = has_flag(status, "high_voltage")
            self._expect("high_voltage", when, f"high_voltage {condition}", must_be_on, is_on)

    # Achieved values

    def _check_achieved(self, layer: int, reply: Values, when: Interval) -> None:
        """Compare the achieved values of a layer with its commands."""
        if self.may_start(when):
            return
        sure_layers = self.outputs.sure(when)
        if not sure_layers:
            return
        problem = self._achieved_problem(layer, reply, sure_layers)
        if problem is not None:
            report = self.report if reply["commands"] else self.report_silence
            quantity = f"{problem.quantity} of achieved layer {layer}"
            report(
                problem.rule,
                when.latest,
                quantity,
                expected=problem.required,
                actual=problem.received,
            )

    def _achieved_problem(
        self, layer: int, reply: Values, sure_layers: set[int]
    ) -> AchievedProblem | None:
        """Return the first difference between a reply to GetAchieved and the commands of a
        layer."""
        outputs = self.outputs
        possible_tokens = outputs.tokens_of(layer, sure_layers)
        if reply["token"] not in possible_tokens:
            return AchievedProblem("token", "token", alternatives(possible_tokens), reply["token"])
        if layer not in sure_layers:
            return None
        problem = achieved_problem(
            outputs.playback.playing(layer),
            reply,
            self.can,
            is_exact=outputs.is_exact,
            can_scale=outputs.may_derate or not outputs.is_exact,
        )
        if problem is not None:
            return problem
        rows = (reply, *reply["commands"])
        flags = [name for row in rows for name in FLAGS if row.get(name)]
        if flags:
            return AchievedProblem("plays", "flags", [], flags)
        lasting = outputs.lasting.get(layer, {0}) if reply["commands"] else {0}
        if reply["valid_for"] not in lasting:
            return AchievedProblem("plays", "valid_for", sorted(lasting), reply["valid_for"])
        if reply["ramp"] and not reply["commands"]:
            return AchievedProblem("plays", "ramp of a silent layer", 0, reply["ramp"])
        return None

    def report_silence(
        self, rule: str, time: float, quantity: str, *, expected: object, actual: object
    ) -> None:
        """Report unexpected silence as a violation that a hidden fault could explain."""
        self.report(rule, time, quantity, expected=expected, actual=actual)
