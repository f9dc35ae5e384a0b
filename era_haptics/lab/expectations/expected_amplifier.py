"""Expected state of an amplifier after the requests sent to it: states, sessions, sets, outputs.

A request is carried out at some time between sending it and its reply, and a status is true at some
time in between, so both are compared over that whole interval. Nothing is known until the first
status.
"""

import math
from typing import NamedTuple

from drivers.protocol.achieved import TONE
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
from era_haptics.lab.expectations.expected_achieved import check_achieved
from era_haptics.lab.expectations.expected_clock import ExpectedClock
from era_haptics.lab.expectations.expected_faults import ExpectedFaults
from era_haptics.lab.expectations.expected_outputs import ExpectedOutputs
from era_haptics.lab.expectations.expected_set import ExpectedSet
from era_haptics.lab.expectations.expected_watchdog import ExpectedWatchdog
from era_haptics.lab.expectations.mismatches import ReportMismatch, ReportUnclear, alternatives
from era_haptics.lab.expectations.tolerances import ROUNDED, UNKNOWN, Interval

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

    - report: receives violations; unclear: receives the reason why the state is unknown.
    - may_fail: the amplifier can have faults of its own.
    - slack: tolerance of times.
    """

    def __init__(
        self,
        report: ReportMismatch,
        *,
        unclear: ReportUnclear | None = None,
        may_fail: bool = True,
        slack: float = 0.0,
    ) -> None:
        self.report = report
        self.slack = slack
        self.capabilities: Values = {}
        """Reply to GetCaps, empty while unknown."""
        self.last_status = -math.inf
        """Start of the interval without observations."""
        self._report_unclear = unclear
        self._may_fail = may_fail
        # `forget` sets all that follow.
        self.state: int | None
        self.session: int | None
        self.token: int | None
        """Token of the set committed last, 0 after an Arm."""
        self.latch: int | None
        self.fault: int
        self.is_shown: bool
        """Whether the amplifier has reported its state itself."""
        self.silent: Interval
        """When all fades have ended."""
        self.sets: ExpectedSet
        self.clock: ExpectedClock
        self.watchdog: ExpectedWatchdog
        self.outputs: ExpectedOutputs
        self._faults: ExpectedFaults
        self._waiting: _WaitingSet | None
        self._started: float
        """Latest start of a waiting set."""
        self.forget()

    def forget(self, cause: str = "missed messages") -> None:
        """Treat everything as unknown until the next status."""
        self.state = None
        self.session = None
        self.token = None
        self.latch = None
        self.fault = FAULTS["NONE"]
        self.is_shown = True
        self.silent = UNKNOWN
        self.sets = ExpectedSet()
        self.clock = ExpectedClock(self.report, self.slack)
        self.watchdog = ExpectedWatchdog(self.report, self.slack)
        self._faults = ExpectedFaults(self.report, self.slack)
        self._waiting = None
        self._started = -math.inf
        self._settle(cause)
        self.outputs.forget()

    def _settle(self, cause: str, when: Interval = UNKNOWN) -> None:
        """Treat all channels as silent from some time in an interval."""
        self.outputs = ExpectedOutputs(
            self.capabilities,
            report=self.report,
            unclear=self._report_unclear,
            slack=self.slack,
            cause=cause,
            began=when,
        )

    def identified(self, capabilities: Values) -> None:
        """Record the capabilities of the amplifier."""
        if capabilities != self.capabilities:
            self.capabilities = capabilities
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

    # Requests

    def granted(self, name: str, values: Values, reply: Values, when: Interval) -> None:
        """Apply a request carried out in an interval, and compare its reply."""
        self.advance(when.earliest)
        self._check_allowed(name, values, when.latest)
        may_have_expired = reply.get("state") in (REACTING, FAULT)
        if name in FEEDING and self.state in (None, ENABLED) and not may_have_expired:
            self.watchdog.fed = when
        match name:
            case "Set":
                self._take(values, reply, when)
            case "GetAchieved":
                if not self.may_start(when):
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
            self.report("token", time, f"token of {name}", expected=expected, actual=token)
        if self.state not in (None, *_ONLY_IN.get(name, (self.state,))):
            rule = _RULE_OF_STATE.get(name, "enabled") if self.is_shown else "watchdog"
            quantity = f"reply to {name} in {self._name_of(self.state)}"
            self.report(rule, time, quantity, expected="WRONG_STATE", actual="carried out")

    def carry_out(self, name: str, values: Values, status: Values, when: Interval) -> None:
        """Apply a request carried out in an interval; status: its reply, or a later status."""
        ramp_max = self.capabilities.get("ramp_max", math.inf)
        ramp = min(values.get("ramp", 0), ramp_max) / 1000
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
        if has_expired and when.latest >= self.watchdog.expiry.earliest:
            tripped = self.watchdog.trip_interval(when.latest, self.last_status)
            self._trip(FAULTS["WATCHDOG"], tripped, "the watchdog")

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
        self.watchdog.time = values["watchdog"] / 1000
        self.watchdog.fed = when

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
        if self.is_enabled and self.watchdog.must_have_tripped(time):
            self._trip(FAULTS["WATCHDOG"], self.watchdog.expiry, "the watchdog")
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
        steps = [self.capabilities.get(f"{quantity}_step", 1) for quantity in TONE]
        has_fine_steps = max(steps) <= 1
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
            self.watchdog.fed = when

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
        remaining = status["watchdog_left"] / 1000
        cause = self.outputs.cause
        self.watchdog.check_remaining(remaining, when, is_enabled=self.is_enabled, cause=cause)
        self.clock.check(status["clock"], when)
        if not self.may_start(when):
            self.outputs.check(status, when)
        self._check_voltage(status, when)
        self.last_status = when.earliest

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
                self.watchdog.fed = past
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
            enabled_until = when.latest if self.is_enabled else self.outputs.began.latest
            self.watchdog.check_trip(enabled_until, when, cause=self.outputs.cause)
            fault_time = self.watchdog.trip_interval(when.latest, self.last_status)
        elif fault == FAULTS["NONE"] or not self._may_fail:
            expected = "WATCHDOG" if fault else "one"
            quantity = "fault of a fault reaction"
            self.report("state", when.latest, quantity, expected=expected, actual=name)
        self._trip(fault, fault_time, f"fault {name}")

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

    def _check_achieved(self, layer: int, reply: Values, when: Interval) -> None:
        """Compare the achieved values of a layer with its commands."""
        check_achieved(
            layer,
            reply,
            when,
            outputs=self.outputs,
            capabilities=self.capabilities,
            report=self.report,
        )
