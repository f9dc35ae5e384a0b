"""State, fault, latch and watchdog of an amplifier, as they must be and as it reports them."""

import math

from drivers.protocol.records import Values
from drivers.protocol.sets import is_newer_token
from drivers.protocol.table import FAULTS, LATCHED, QUANTITIES, STATES, STATUS_FLAGS
from drivers.uncertain_playback import Interval
from sim.witness.capture import ReportViolation
from sim.witness.decoded import ENABLED, Sent
from sim.witness.expected_outputs import ExpectedOutputs, SetReplies

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
_NAMES = {number: name for name, number in STATES.items()}
_CLOCK = 0.01  # share of an age by which the clock of an amplifier may be wrong
_LEFT = 0.011  # s; tolerance of the reported time left, as that of a host
_ROUNDING = 0.002  # s; of an age


class Watchdog:
    """The watchdog of an amplifier; time [s]: as set by Arm, infinite before.

    fed: when it was last, known only as an interval from request to reply. slack [s]: tolerance.
    """

    def __init__(self, slack: float) -> None:
        self.time = math.inf
        self.fed = (-math.inf, math.inf)
        self._slack = slack
        self._latest_before = math.inf

    def __str__(self) -> str:
        """Its state, for messages."""
        return f"watchdog of {self.time:g} s fed at {self.fed[0]:.4f} to {self.fed[1]:.4f} s"

    @property
    def expiry(self) -> tuple[float, float]:
        """Earliest and latest time of expiry [s]."""
        return self.fed[0] + self.time, self.fed[1] + self.time

    def may_feed(self, time: float) -> None:
        """Note a request that feeds it unless refused; `undo_feed` takes it back."""
        self._latest_before = self.fed[1]
        self.fed = (self.fed[0], max(self.fed[1], time))

    def undo_feed(self) -> None:
        """Note the refusal of the request given to `may_feed`."""
        self.fed = (self.fed[0], self._latest_before)

    def has_expired(self, time: float) -> bool:
        """Whether it must have expired."""
        return time > self.expiry[1] + self._slack

    def may_have_expired(self, time: float) -> bool:
        """Whether it may have expired."""
        return time > self.expiry[0] - self._slack

    def left_problem(self, left: float, begin: float, end: float) -> str:
        """Describe what is wrong with a time left [s], true at some time between two; or ""."""
        low = self.time - (end - self.fed[0]) - _LEFT - self._slack
        high = self.time - max(0.0, begin - self.fed[1]) + _LEFT + self._slack
        if self.time == math.inf or low <= left <= high:
            return ""
        return f"watchdog_left must be {low:.3f} to {high:.3f} s, got {left:g} s: {self}"


class ExpectedState:
    """The expected state of one amplifier by name, None while it is unknown; times [s].

    is_answered: it has said its state in a reply; last_fault: when it was seen to enter a fault;
    reported_at: when it reported a state other than before. unanswered: requests that have no
    reply, and may have been carried out.
    """

    def __init__(self, name: str, *, slack: float, report: ReportViolation) -> None:
        self.state: int | None = None
        self.is_answered = True
        self.last_fault = self.reported_at = -math.inf
        self.watchdog = Watchdog(slack)
        self.outputs = ExpectedOutputs(slack=slack, report=self._report)
        self.sets = SetReplies()
        self.unanswered: list[Sent] = []
        self._name = name
        self._report_sentence = report
        self._slack = slack
        self._fault = 0
        self._is_reported = True  # it has reported this state
        self._fault_since: Interval | None = None  # when the present one came, if known
        self._last_status = -math.inf
        self._latch: int | None = None

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
        if self.is_enabled and self.watchdog.has_expired(time) and not self.unanswered:
            self._silence(self.watchdog.expiry, SILENCING_RAMP, "the watchdog")
            self.state, self._fault, self._is_reported = REACTING, FAULTS["WATCHDOG"], False
            self.is_answered = False
            self.last_fault, self._fault_since = time, self.watchdog.expiry

    def _report(self, rule: str, time: float, what: str) -> None:
        """Report what it does, or is."""
        self._report_sentence(rule, time, f"{self._name} {what}")

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
            self._report(
                self._rule_against(now), end, self._in(now, f", must be in {_NAMES[here]}")
            )
        elif self._is_reported and self._fault and fault != self._fault and now in LATCHED:
            self._report("latched", end, f"reports fault {fault} instead of {self._fault}")
        self._fault = fault if now in (REACTING, FAULT) else 0
        self.outputs.resolve_suspicions(is_enabled=now not in (REACTING, FAULT))
        if now != here or not self._is_reported:
            self.reported_at = end
        self.state, self._is_reported = now, True

    def _in(self, state: int | None, what: str) -> str:
        name = "an unknown state" if state is None else _NAMES[state]
        return f"is in {name}{what}; {self.watchdog}"

    def _rule_against(self, now: int) -> str:
        """Which rule a state breaks."""
        if not self._is_reported:
            return "watchdog" if now == ENABLED else "latched"
        if now == ENABLED:
            return "armed"
        return "latched" if self.state in LATCHED else "state"

    def _adopt(self, state: int, fault: int, time: float) -> None:
        """Adopt a reported state where it is unknown."""
        self.state, self._fault, self._is_reported = state, fault, True
        self._fault_since = None
        if state in (*OFF, FAULT):
            self.outputs.settle(_NAMES[state])
        elif state == ENABLED:
            self.watchdog.fed = (-math.inf, time)

    def _check_trip(self, state: int, fault: int, end: float) -> None:
        """Check a transition into a fault: the watchdog not before its time."""
        since = (min(self._last_status, end), end)
        if fault == FAULTS["WATCHDOG"]:
            if not self.watchdog.may_have_expired(end):
                self._report("watchdog", end, f"expired at {end:.4f} s: {self.watchdog}")
            since = (min(max(self.watchdog.expiry[0], self._last_status), end), end)
        elif fault == FAULTS["NONE"]:
            self._report("state", end, self._in(state, " without a fault"))
        self._fault_since = since if since[0] > -math.inf else None
        self._silence((max(since[0], end - 2.0), end), SILENCING_RAMP, "a fault")

    def _note_latch(self, latch: int, state: int, end: float, *, after: str) -> None:
        """Compare the latch: newer after each stop and fault, else as it was."""
        before, self._latch = self._latch, latch
        if before is None:
            return
        is_newer = latch > 0 and is_newer_token(latch, before)
        if after == "Stop" and not is_newer:
            what = f"reports latch {latch} after Stop, must be newer than {before}"
            self._report("latched", end, what)
        elif latch != before and not (is_newer and state in LATCHED):
            what = f"reports latch {latch} in {_NAMES[state]}, must be {before}"
            self._report("latched", end, what)

    def _check_left(self, left: int, state: int, begin: float, end: float) -> None:
        """Check the time left of the watchdog."""
        seconds = QUANTITIES["watchdog_left"].from_wire(left)
        problem = ""
        if state == ENABLED:
            problem = self.watchdog.left_problem(seconds, begin, end)
        elif state in OFF and left:
            problem = "watchdog runs while disarmed"
        if problem:
            self._report("watchdog", end, problem)

    def _check_flags(self, flags: int, state: int, begin: float, end: float) -> None:
        """Check whether high voltage is on, and whether a sum was limited."""
        is_limited = bool(flags >> STATUS_FLAGS["limited"] & 1)
        self.outputs.check_limited(begin, end, is_limited=is_limited)
        is_on = bool(flags >> STATUS_FLAGS["high_voltage"] & 1)
        must = {ENABLED: True, FAULT: False}.get(state, False if state in OFF else None)
        if must is not None and must != is_on:
            what = f"reports high voltage {'on' if is_on else 'off'} in {_NAMES[state]}"
            self._report("high_voltage", end, what)

    def _check_faults(self, values: Values, begin: float, end: float) -> None:
        """Check a list of faults: newest first, with the present one, of the age that it has."""
        faults = [(each["fault"], each["age"] / 1000) for each in values["faults"]]
        ages = [age for fault, age in faults if fault == self._fault]
        if faults != sorted(faults, key=lambda each: each[1]):
            self._report("faults", end, f"lists faults {faults}, must be newest first")
        elif not self.is_in_fault or not self._is_reported or self.unanswered:
            return
        elif not ages:
            self._report("faults", end, f"is in fault {self._fault}, which it does not list")
        elif self._fault_since is not None:
            low = begin - self._slack - self._fault_since[1] - _ROUNDING
            high = end + self._slack - self._fault_since[0] + _ROUNDING
            if not any(low <= age * (1 + _CLOCK) and age * (1 - _CLOCK) <= high for age in ages):
                what = f"lists fault {self._fault} of {ages} s ago, must be {low:.3f} to {high:.3f}"
                self._report("faults", end, what)

    def _silence(self, when: Interval, ramp: float, cause: str) -> None:
        self.sets.drop()
        self.outputs.silence((max(when[0], -1e9), when[1]), ramp, cause)
