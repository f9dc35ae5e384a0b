"""State, fault, latch and watchdog of an amplifier, as they must be and as it reports them."""

import math

from drivers.protocol.records import Values
from drivers.protocol.table import FAULTS, LATCHED, QUANTITIES, STATES
from drivers.protocol.tokens import is_newer_token
from sim.witness.expected_outputs import ExpectedOutputs, Interval
from sim.witness.reports import fault_list_problem
from sim.witness.set_replies import SetReplies
from sim.witness.unanswered import ENABLED, Unanswered
from sim.witness.violation import ReportViolation
from sim.witness.watchdog import Watchdog

SILENCING_RAMP = 0.005  # s; along which the watchdog and faults silence
STOPPED = STATES["QUICK_STOP_ACTIVE"]
REACTING, FAULT = STATES["FAULT_REACTION_ACTIVE"], STATES["FAULT"]
DISABLED, SWITCHED_ON = STATES["SWITCH_ON_DISABLED"], STATES["SWITCHED_ON"]
OFF = (STATES["NOT_READY"], DISABLED, STATES["READY_TO_SWITCH_ON"])
_SPONTANEOUS = {
    SWITCHED_ON: (SWITCHED_ON, DISABLED),
    REACTING: (REACTING, FAULT),
    **dict.fromkeys(OFF, OFF),
}
"""States that an amplifier may enter from a state without a request."""
NAMES = {number: name for name, number in STATES.items()}


class ExpectedState:
    """The expected state of one amplifier by name, None while it is unknown; times [s].

    is_answered: it has said its state in a reply; last_fault: when it was seen to enter a fault;
    reported_at: when it reported a state other than before.
    """

    def __init__(self, name: str, *, slack: float, report: ReportViolation) -> None:
        self.state: int | None = None
        self.is_answered = True
        self.last_fault = self.reported_at = -math.inf
        self.watchdog = Watchdog(name, slack=slack, report=report)
        self.outputs = ExpectedOutputs(name, slack=slack, report=report)
        self.sets = SetReplies(name, report=report)
        self._name = name
        self._report = report
        self._slack = slack
        self._fault = 0
        self._is_reported = True  # it has reported this state
        self._fault_since: Interval | None = None  # when the present one came, if known
        self._last_status = -math.inf
        self._latch: int | None = None
        self._unanswered = Unanswered()

    @property
    def is_enabled(self) -> bool:
        """Whether it is armed, as far as is known."""
        return self.state == ENABLED

    @property
    def is_in_fault(self) -> bool:
        """Whether it is in a fault, or reacting to one."""
        return self.state in (REACTING, FAULT)

    def advance(self, time: float) -> None:
        """Apply what must have happened without a request until now."""
        if self.state == ENABLED and self.watchdog.has_expired(time) and not self._unanswered:
            self._silence(self.watchdog.expiry, SILENCING_RAMP, "the watchdog")
            self.state, self._fault, self._is_reported = REACTING, FAULTS["WATCHDOG"], False
            self.is_answered = False
            self.last_fault, self._fault_since = time, self.watchdog.expiry

    def _note_state(self, now: int, fault: int, end: float) -> None:
        """Compare a state and a fault with those expected, and go on with them."""
        here = self.state
        if here is None:
            self._adopt(now, fault, end)
            return
        if now in (REACTING, FAULT) and here not in (*OFF, REACTING, FAULT):
            self.last_fault = end
            self._check_trip(now, fault, end)
        elif now not in _SPONTANEOUS.get(here, (here,)):
            self._report(self._rule_against(now), end, self._state_problem(now))
        elif self._is_reported and self._fault and fault != self._fault and now in LATCHED:
            what = f"{self._name} reports fault {fault} instead of {self._fault}"
            self._report("latched", end, what)
        self._fault = fault if now in (REACTING, FAULT) else 0
        self.outputs.resolve_suspicions(is_enabled=now not in (REACTING, FAULT))
        if now != here or not self._is_reported:
            self.reported_at = end
        self.state, self._is_reported = now, True

    def _adopt(self, state: int, fault: int, time: float) -> None:
        """Adopt a reported state where it is unknown."""
        self.state, self._fault, self._is_reported = state, fault, True
        self._fault_since = None
        if state in (*OFF, FAULT):
            self.outputs.settle(NAMES[state])
        elif state == ENABLED:
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
            return "watchdog" if now == ENABLED else "latched"
        if now == ENABLED:
            return "armed"
        return "latched" if self.state in LATCHED else "state"

    def _state_problem(self, now: int) -> str:
        if not self._is_reported and now == ENABLED:
            return f"{self._name} is still enabled: {self.watchdog}"
        return f"{self._name} must be in {self._state_name()}, got {NAMES[now]}"

    def _check_left(self, left: int, state: int, begin: float, end: float) -> None:
        if state == ENABLED:
            seconds = QUANTITIES["watchdog_left"].from_wire(left)
            self.watchdog.check_left(seconds, begin, end)
        elif state in OFF and left:
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

    def _silence(self, when: Interval, ramp: float, cause: str) -> None:
        self.sets.drop()
        self.outputs.silence((max(when[0], -1e9), when[1]), ramp, cause)

    def _state_name(self) -> str:
        return NAMES[self.state] if self.state is not None else "an unknown state"
