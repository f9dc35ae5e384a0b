"""The states of an amplifier as they must be: latch, watchdog, faults, high voltage."""

import math
from collections import deque
from collections.abc import Sequence

from drivers.judge.outputs import DRIFT, ExpectedOutputs, Report, Unclear, one_of
from drivers.playing.uncertain import Interval
from drivers.protocol.definition import (
    ENABLED,
    FAULTS,
    LATCHED,
    NO_CHANNEL,
    STATES,
    has_flag,
    name_of,
)
from drivers.protocol.records import Values
from drivers.protocol.sets import token_after

ROUNDED = 0.002  # s; of times in milliseconds
_TRIP, FADE, _SETTLING = 0.005, 0.005, 0.01  # s; until a trip, of a fault, until a state shows
OFF, STOPPED = STATES["SWITCH_ON_DISABLED"], STATES["QUICK_STOP_ACTIVE"]
REACTING, FAULT = STATES["FAULT_REACTION_ACTIVE"], STATES["FAULT"]
SWITCHED_ON, _READY = STATES["SWITCHED_ON"], STATES["READY_TO_SWITCH_ON"]
DISARMED = STATES["NOT_READY"], OFF, _READY
_FALLING = {SWITCHED_ON: OFF, REACTING: FAULT}
"""States until all is silent, and then."""
_NEVER: Interval = (-math.inf, math.inf)


class ExpectedStates:
    """The states of one amplifier; state and latch are None while unknown; times [s].

    report: takes what is wrong, always: what nothing excuses, unclear: why that is not known.
    may_fail: it may have faults of its own. slack: of times, left_slack: of the time that is left
    of the watchdog. fed: when that was fed last, silent: when all that fades is silent. is_shown:
    it has shown its state itself. last_status: since when nothing was seen. can: its capabilities.
    """

    def __init__(
        self,
        report: Report,
        always: Report,
        *,
        unclear: Unclear | None = None,
        may_fail: bool = True,
        slack: float = 0.0,
        left_slack: float = ROUNDED,
    ) -> None:
        self.can: Values = {}
        self.report, self._always, self._unclear = report, always, unclear
        self._may_fail, self.slack, self._left_slack = may_fail, slack, left_slack
        self.forget()
        self.last_status = -math.inf

    def _expect(self, rule: str, time: float, what: str, must: object, seen: object) -> None:
        """Report what is not as it must be."""
        if must != seen:
            self.report(rule, time, what, must=must, seen=seen)

    def forget(self, cause: str = "what was not heard") -> None:
        """Treat all as unknown until the next status."""
        self.state: int | None = None
        self.fault = FAULTS["NONE"]
        self.latch: int | None = None
        self.watchdog, self.fed, self.silent = math.inf, _NEVER, _NEVER
        self.is_shown = True
        self._faults: deque[tuple[int, Interval]] = deque(maxlen=2)  # the newest first, and when
        self._settle(cause)
        self.outputs.forget()

    def _settle(self, cause: str, when: Interval = _NEVER) -> None:
        """Treat all channels as silent from some time between two on."""
        self.outputs = ExpectedOutputs(
            self.can,
            report=self.report,
            unclear=self._unclear,
            slack=self.slack,
            cause=cause,
            began=when,
        )

    def identified(self, capabilities: Values) -> None:
        """Note its capabilities."""
        if capabilities != self.can:
            self.can = capabilities
            self._settle("what was not heard")
            self.outputs.forget()

    @property
    def is_enabled(self) -> bool:
        """Whether it is armed, as far as is known."""
        return self.state == ENABLED

    @property
    def is_in_fault(self) -> bool:
        """Whether it is in a fault, or reacting to one."""
        return self.state in (REACTING, FAULT)

    @property
    def expiry(self) -> Interval:
        """When the watchdog trips if it is not fed, at the earliest and at the latest."""
        if self.watchdog == math.inf:  # not known
            return _NEVER
        early, late = self.watchdog * (1 - DRIFT), (self.watchdog + _TRIP) * (1 + DRIFT)
        return self.fed[0] + early - ROUNDED, self.fed[1] + late

    # What it does

    def _trip(self, fault: int, since: Interval, cause: str) -> None:
        self.fault = fault
        self._latch_again()
        self._faults.appendleft((fault, since))
        is_whole = fault == FAULTS["WATCHDOG"] and not self._may_fail
        self._fall_silent(REACTING, since, FADE, cause, has_floor=is_whole)

    def _latch_again(self) -> None:
        self.latch = None if self.latch is None else token_after(self.latch)

    def _fall_silent(
        self, state: int, when: Interval, ramp: float, cause: str, *, has_floor: bool = True
    ) -> None:
        self.state = state
        self.silent = self.outputs.silence(when, ramp, cause, has_floor=has_floor)

    def _clear(self, latch: int, state: int, when: Interval) -> None:
        """Leave a stop or a fault, once all is silent, where its cause is gone."""
        is_gone = self.fault in (FAULTS["NONE"], FAULTS["WATCHDOG"])
        is_off = state in DISARMED and when[1] >= self.silent[0] - ROUNDED
        if is_off and self.latch is not None:
            self._expect("latched", when[1], "latch of Clear", self.latch, latch)
        if is_off or (is_gone and self._is_silent(when)):
            self.state, self.fault = OFF, FAULTS["NONE"]
            self.outputs.cause = "Clear"

    # What it shows

    def note_state(self, shown: Values, when: Interval) -> bool:
        """Compare state, fault and latch, and go on with them; returns whether the state fits."""
        now, fault, latch, end = shown["state"], shown["fault"], shown["latch"], when[1]
        if self.state is None:
            self._adopt(shown, when)
        before = self.state
        if now in (REACTING, FAULT) and before in (ENABLED, SWITCHED_ON, STOPPED):
            self._tripped(fault, when)
        known = self._states(when)
        if now not in known:
            what = f"state {when[0] - self.outputs.began[1]:.3f} s after {self.outputs.cause}"
            must = one_of(map(self._name_of, known))
            self.report(self._rule_against(now), end, what, must=must, seen=self._name_of(now))
            return False
        if fault and fault != self.fault and self._may_fail and not self.is_shown:
            self.fault = fault  # which came before the watchdog, of which nothing was seen
            self._faults[0] = fault, (self.last_status, end)
        rule, cause = "latched" if now in LATCHED else "state", self.outputs.cause
        self._expect(rule, end, f"fault after {cause}", self.fault, fault)
        if self.latch is not None:
            self._expect("latched", end, f"latch after {cause}", self.latch, latch)
        self.state, self.fault, self.latch, self.is_shown = now, fault, latch, True
        return True

    def _is_silent(self, when: Interval) -> bool:
        """Whether it must have been silent, and its state show so, between two times."""
        return when[0] > self.silent[1] + _SETTLING + ROUNDED + self.slack

    def _states(self, when: Interval) -> list[int]:
        """Return the states in which it may be between two times."""
        here = self.state or 0
        if here not in _FALLING:
            return [0, OFF] if here == STATES["NOT_READY"] else [here]
        states = [] if self._is_silent(when) else [here]
        if when[1] > self.silent[0] - ROUNDED - self.slack:
            states.append(_FALLING[here])
        return states

    def _rule_against(self, now: int) -> str:
        """Which rule a state breaks."""
        if not self.is_shown:
            return "watchdog" if now == ENABLED else "latched"
        if now == ENABLED:
            return "armed"
        return "latched" if self.state in LATCHED else "state"

    def _tripped(self, fault: int, when: Interval) -> None:
        """Check a transition into a fault: the watchdog not before its time."""
        since = min(self.last_status, when[1]), when[1]
        if fault == FAULTS["WATCHDOG"]:
            early, late = self.expiry
            enabled_until = when[1] if self.is_enabled else self.outputs.began[1]
            if enabled_until < early - self.slack:
                what = f"time of the watchdog ({self.outputs.cause})"
                must = f"from {early:.4f} to {late:.4f} s"
                self.report("watchdog", when[1], what, must=must, seen=f"{when[1]:.4f} s")
            since = self._expired_by(when[1])
        elif fault == FAULTS["NONE"] or not self._may_fail:
            must, seen = "WATCHDOG" if fault else "one", name_of(FAULTS, fault)
            self.report("state", when[1], "fault of a fault reaction", must=must, seen=seen)
        self._trip(fault, since, f"fault {name_of(FAULTS, fault)}")

    def _expired_by(self, time: float) -> Interval:
        """Return between which times the watchdog tripped that has tripped by a time."""
        early, late = self.expiry
        first = min(max(early, self.last_status), time)
        return first, max(min(late, time), first)

    def _adopt(self, shown: Values, when: Interval) -> None:
        """Go on with a status as it is."""
        state = shown["state"]
        if state != self.state:
            self.state, self.silent = state, (-math.inf, math.inf)
            if state in (*DISARMED, FAULT):
                self._settle(self._name_of(state), when)
                self.silent = -math.inf, when[1]
            elif state == ENABLED:
                self.fed = -math.inf, when[1]
                self.outputs.forget()
            if self.is_in_fault:
                self._faults.appendleft((shown["fault"], (-math.inf, when[1])))
        self.fault, self.latch = shown["fault"], shown["latch"]
        self.is_shown, self.last_status = True, when[0]

    def _name_of(self, state: int | None) -> str:
        return "unknown" if state is None else name_of(STATES, state)

    def _check_voltage(self, shown: Values, when: Interval) -> None:
        """Check high voltage, and the interlock of one that has it."""
        is_fading = when[1] < self.silent[0] - ROUNDED - self.slack and any(shown["levels"])
        must_be = self.state in (ENABLED, SWITCHED_ON) or (self.state == STOPPED and is_fading)
        where, end = f"in {self._name_of(self.state)} after {self.outputs.cause}", when[1]
        if must_be:
            is_open = has_flag(shown, "interlock_open")
            self._expect("high_voltage", end, f"interlock_open {where}", False, is_open)
        if must_be or self._is_silent(when):
            is_on = has_flag(shown, "high_voltage")
            self._expect("high_voltage", end, f"high_voltage {where}", must_be, is_on)

    def _check_faults(self, listed: Sequence[Values], when: Interval) -> None:
        """Check a list of faults: the newest first, those that were seen, of their ages."""
        ages = [each["age"] for each in listed]
        self._expect("faults", when[1], "ages of faults", sorted(ages), ages)
        unfed = {each["channel"] for each in listed if each["fault"] == FAULTS["WATCHDOG"]}
        self._expect("faults", when[1], "channels of watchdog faults", set(), unfed - {NO_CHANNEL})
        faults = [(each["fault"], each["age"] / 1000) for each in listed]
        left = iter(faults)
        for fault, since in self._faults:
            drift = DRIFT * (when[1] - since[0])
            slack = ROUNDED + self.slack + (drift if drift < math.inf else 0.0)
            low, high = when[0] - since[1] - slack, when[1] - since[0] + slack
            if not any(each == fault and low <= age <= high for each, age in left):
                must = f"{name_of(FAULTS, fault)} of {low:.3f} to {high:.3f} s ago, in its turn"
                self.report("faults", when[1], "listed faults", must=must, seen=faults)
                return
