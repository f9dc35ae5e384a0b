"""Expected state of an amplifier after the requests sent to it: states, sessions, sets, outputs.

A request is carried out at some time between sending it and its reply, and a status is true at some
time in between, so both are compared over that whole interval. Nothing is known until the first
status.
"""

import math
from collections import deque
from collections.abc import Sequence
from typing import TypeAlias

from drivers.protocol.definition import (
    ENABLED,
    FAULTS,
    LATCHED,
    MESSAGES,
    NO_CHANNEL,
    QUANTITIES,
    STAGED_LIFE,
    STATES,
    has_flag,
    name_of,
)
from drivers.protocol.records import Refusal, Values
from drivers.protocol.sets import (
    FLAGS,
    TONE,
    Assembly,
    LayerSet,
    Problem,
    achieved_problem,
    is_newer_token,
    token_after,
    unpack_layers,
)
from era_haptics.lab.expected_output import (
    DRIFT,
    ExpectedClock,
    ExpectedOutputs,
    Interval,
    ReportMismatch,
    Unclear,
    one_of,
)


class ExpectedSet:
    """The newest set sent to one amplifier; times [s]. is_exact: it plays without rounding.

    staged: token of the staged set, 0 for none. has_expired: one may have expired by now.
    """

    def __init__(self) -> None:
        self.is_exact, self.has_expired = True, False
        self._whole: tuple[int, tuple[LayerSet, ...]] = (0, ())  # token, and layers
        self._replaced = 0  # token of the set whose achieved values are known
        self.drop()

    def drop(self) -> None:
        """Discard all collected and staged parts."""
        self._parts = Assembly()  # that are kept
        self.staged = 0
        self._began: Interval = (-math.inf, -math.inf)  # interval in which the first part arrived
        self._is_unclear = False  # whether it is unclear if a part arrived before the set expired

    def keep(self, part: Values, when: Interval) -> bool:
        """Record a part other than the last that arrives in an interval; returns whether it is
        kept."""
        token = part["token"]
        self.expire(when)
        if token != self._parts.token:
            if not is_newer_token(token, self._parts.token):
                return False
            self.drop()
            self._began = when
        return not self.staged and self._parts.keep(part, when[1])

    def sent(self, last: Values) -> str:
        """Record that the last part of a set was sent; returns its error, or ""."""
        stream = self._parts.whole(last)
        try:
            if not isinstance(stream, int):
                self._whole = last["token"], unpack_layers(stream)
        except Refusal as refusal:
            return str(refusal)
        return ""

    def whole(self, token: int) -> tuple[LayerSet, ...] | None:
        """Return the layers of a set if all its parts were sent."""
        return self._whole[1] if token == self._whole[0] else None

    def replace(self, token: int, layers: tuple[LayerSet, ...]) -> None:
        """Record the achieved layers of a set."""
        self._whole, self.is_exact, self._replaced = (token, layers), True, token

    def staged_until(self, token: object) -> Interval:
        """Return the interval in which a set expires if it is staged."""
        if not self.staged or token != self.staged:
            return -math.inf, -math.inf
        return self._began[0] + STAGED_LIFE, self._began[1] + STAGED_LIFE

    def taken(self, last: Values, reply: Values, when: Interval) -> Sequence[int] | None:
        """Record the reply to the last part of a set, which arrived within an interval.

        Returns the expected `missing`, `staged` and `played`; None if the set expired in that
        interval.
        """
        token = last["token"]
        self.expire(when)
        is_unclear, is_under_way = self._is_unclear, token == self._parts.token
        stream = [] if is_under_way and self.staged else self._parts.whole(last)
        if reply["staged"] or reply["played"]:
            self.is_exact = bool(reply["exact"]) or token == self._replaced
            if not is_under_way:
                self.drop()
                self._parts, self._began = Assembly(token, last["parts"], when[1]), when
            self.staged = token if reply["staged"] else 0
            self._began = self._began[0], (when[1] if is_unclear else self._began[1])
        elif is_under_way:
            self.staged = 0
            self._parts.collected.pop(reply["missing"], None)
        if is_unclear:
            return None
        if isinstance(stream, int):
            return stream, 0, 0
        return 0, 1 - last["now"], last["now"]

    def refused(self, last: Values) -> None:
        """Record that a last part was rejected, and with it the set if all other parts arrived."""
        is_own = last["token"] == self._parts.token and not self.staged
        is_one = last["index"] < last["parts"] == self._parts.count
        if is_own and is_one and not isinstance(self._parts.whole(last), int):
            self.drop()

    def expire(self, when: Interval) -> None:
        """Drop the set if it expired before the end of an interval."""
        lived = when[0] - self._began[1], when[1] - self._began[0]
        self.has_expired |= STAGED_LIFE < lived[1] < math.inf
        if lived[0] > STAGED_LIFE:
            self.drop()
        self._is_unclear |= lived[0] <= STAGED_LIFE < lived[1]


ROUNDED = 0.002  # s, rounding of times in milliseconds
_TRIP, FADE, _SETTLING = (
    0.005,
    0.005,
    0.01,
)  # s; until a trip; fade after a fault; until a state is reported
OFF, STOPPED = STATES["SWITCH_ON_DISABLED"], STATES["QUICK_STOP_ACTIVE"]
REACTING, FAULT = STATES["FAULT_REACTION_ACTIVE"], STATES["FAULT"]
SWITCHED_ON, _READY = STATES["SWITCHED_ON"], STATES["READY_TO_SWITCH_ON"]
DISARMED = STATES["NOT_READY"], OFF, _READY
_FALLING = {SWITCHED_ON: OFF, REACTING: FAULT}
"""States during a fade, and the states after it."""
_NEVER: Interval = (-math.inf, math.inf)

_WARM = QUANTITIES["temperature"].to_wire(60.0)  # above this temperature an amplifier can derate
FEEDING = frozenset(name for name, message in MESSAGES.items() if message.feeds)
"""Requests that feed the watchdog unless they are rejected."""
_ONLY_IN = {
    **dict.fromkeys(("Set", "Commit", "Silence"), (ENABLED,)),
    "SetAddress": DISARMED,
    "Arm": (*DISARMED, SWITCHED_ON, ENABLED),
}
"""The only states in which a request is accepted."""
_NOT_LOOKED_AT = "WRONG_SESSION", "WRONG_STATE", "BUSY"
"""Reasons for rejecting a part that do not depend on its content."""
_Waiting: TypeAlias = tuple[Interval, int, tuple[LayerSet, ...], bool]
"""A committed set: its start, token and layers, and whether it plays without rounding."""


def request_text(name: str, values: Values) -> str:
    """Return a request with its values, as reasons name it, without the words of a set."""
    fields = [field for field in MESSAGES[name].request.names if field in values]
    shown = [f"{field} {values[field]}" for field in fields if field != "stream"]
    return f"{name} ({', '.join(shown)})" if shown else name


class ExpectedAmplifier:
    """Expected state of an amplifier; state, latch, token and session are None if unknown; times
    [s].

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

    def forget(self, cause: str = "missed messages") -> None:
        """Treat everything as unknown until the next status."""
        self.token: int | None = None
        self.session: int | None = None
        self.sets = ExpectedSet()
        self.clock = ExpectedClock(self.report, self.slack)
        self._waiting: _Waiting | None = None
        self._started = -math.inf  # latest start of a waiting set
        self.state: int | None = None
        self.fault = FAULTS["NONE"]
        self.latch: int | None = None
        self.watchdog, self.fed, self.silent = math.inf, _NEVER, _NEVER
        self.is_shown = True
        self._faults: deque[tuple[int, Interval]] = deque(
            maxlen=2
        )  # newest first, with their intervals
        self._settle(cause)
        self.outputs.forget()

    def _settle(self, cause: str, when: Interval = _NEVER) -> None:
        """Treat all channels as silent from some time in an interval."""
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
            self._settle("missed messages")
            self.outputs.forget()

    def _expect(self, rule: str, time: float, what: str, must: object, seen: object) -> None:
        """Report a value that differs from the expected one."""
        if must != seen:
            self.report(rule, time, what, must=must, seen=seen)

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
            return _NEVER
        early, late = self.watchdog * (1 - DRIFT), (self.watchdog + _TRIP) * (1 + DRIFT)
        return self.fed[0] + early - ROUNDED, self.fed[1] + late

    # Requests

    def granted(self, name: str, values: Values, reply: Values, when: Interval) -> None:
        """Apply a request carried out in an interval, and compare its reply."""
        self.advance(when[0])
        self._check_allowed(name, values, when[1])
        is_late = reply.get("state") in (REACTING, FAULT)  # it can have expired before
        if name in FEEDING and self.state in (None, ENABLED) and not is_late:
            self.fed = when
        match name:
            case "Set":
                self._take(values, reply, when)
            case "GetAchieved":
                self._check_achieved(values["layer"], reply, when)
            case "GetFaults":
                self._check_faults(reply["faults"], when)
            case _:
                self.carry_out(name, values, reply, when)
        if "levels" in reply:
            self.check(reply, when)

    def _check_allowed(self, name: str, values: Values, time: float) -> None:
        """Check that only the held session plays and feeds, and that nothing plays unless armed."""
        session, token = values.get("session"), values.get("token", 0)
        if name in FEEDING and self.is_enabled and self.session not in (None, session):
            self.report("session", time, f"session of {name}", must=self.session, seen=session)
        if self.token and token not in (0, self.token) and not is_newer_token(token, self.token):
            must = f"newer than {self.token}"
            self._always("token", time, f"token of {name}", must=must, seen=token)
        if self.state not in (None, *_ONLY_IN.get(name, (self.state,))):
            rule = "latched" if name == "Arm" else "state" if name == "SetAddress" else "enabled"
            rule = rule if self.is_shown else "watchdog"
            self.report(
                rule,
                time,
                f"reply to {name} in {self._name_of(self.state)}",
                must="WRONG_STATE",
                seen="carried out",
            )

    def carry_out(self, name: str, values: Values, shown: Values, when: Interval) -> None:
        """Apply a request carried out in an interval, as its reply or a later status shows."""
        ramp = min(values.get("ramp", 0), self.can.get("ramp_max", math.inf)) / 1000
        cause = request_text(name, values)
        has_expired = self.is_enabled and shown.get("fault") == FAULTS["WATCHDOG"]
        if name in ("Stop", "Disarm") and has_expired and when[1] >= self.expiry[0]:
            self._trip(FAULTS["WATCHDOG"], self._expired_by(when[1]), "the watchdog")  # first
        match name:
            case "Arm":
                if not self.is_enabled or values["session"] != self.session:
                    self._fall_silent(ENABLED, when, FADE, cause, has_floor=False)
                    self.token = 0
                    self.clock.shifted()
                self.fault, self.session, self.is_shown = FAULTS["NONE"], values["session"], True
                self.watchdog, self.fed = values["watchdog"] / 1000, when
            case "Silence":
                self._fall_silent(ENABLED, when, ramp, cause)
            case "Disarm" if self.state is not None:
                state = SWITCHED_ON if self.is_enabled else self.state
                self._fall_silent(state, when, ramp, cause)
            case "Stop" if self.state is not None:
                self._latch_again()
                self._fall_silent(self.state if self.is_in_fault else STOPPED, when, ramp, cause)
            case "Clear" if self.state in LATCHED:
                self._clear(values["latch"], shown["state"], when)
            case "Commit":
                self._commit(values, when)
            case "Set" if values["now"]:
                self._play(values["token"], when)
            case "Mark":
                self.clock.mark(when)

    def _clear(self, latch: int, state: int, when: Interval) -> None:
        """Leave a stop or a fault once everything is silent, if its cause has gone."""
        is_gone = self.fault in (FAULTS["NONE"], FAULTS["WATCHDOG"])
        is_off = state in DISARMED and when[1] >= self.silent[0] - ROUNDED
        if is_off and self.latch is not None:
            self._expect("latched", when[1], "latch of Clear", self.latch, latch)
        if is_off or (is_gone and self._is_silent(when)):
            self.state, self.fault = OFF, FAULTS["NONE"]
            self.outputs.cause = "Clear"

    def advance(self, time: float) -> None:
        """Apply everything that must have happened without a request until now."""
        if self.is_enabled and time > self.expiry[1] + ROUNDED + self.slack:
            self._trip(FAULTS["WATCHDOG"], self.expiry, "the watchdog")
            self.is_shown = False
        if self._waiting is not None and time > self._waiting[0][1] + self.slack:
            self._start_waiting()

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
        self.sets.drop()
        if self.may_start(when):  # then the layers that fall silent are unknown
            self.outputs.forget()
        self._waiting = None
        self.state = state
        self.silent = self.outputs.silence(when, ramp, cause, has_floor=has_floor)

    # Sets

    def _take(self, part: Values, reply: Values, when: Interval) -> None:
        """Compare the reply to a part of a set, and play the set if it plays immediately."""
        token, end = part["token"], when[1]
        self._expect("credit", end, "token of a reply to Set", token, reply["token"])
        is_fine = all(self.can.get(f"{each}_step", 1) <= 1 for each in TONE)
        if not (reply["staged"] or reply["played"]):
            self._expect("plays", end, f"exact of set {token}, not whole", 0, reply["exact"])
        elif is_fine and not self.outputs.may_derate:
            self._expect("plays", end, f"exact of set {token}", 1, reply["exact"])
        if token != reply["token"]:
            return
        known = (0, 0, 1) if token == self.token else self.sets.taken(part, reply, when)
        if known is None and self._unclear is not None:
            self._unclear("a part came as its set expired")
        elif known is not None:
            what = f"missing, staged, played after part {part['index']} of set {token}"
            seen = reply["missing"], reply["staged"], reply["played"]
            self._expect("commit", end, what, known, seen)
        if reply["played"]:
            self._play(token, when)

    def part_came(self, part: Values, when: Interval) -> None:
        """Apply a part other than the last, which is kept or dropped without a reply."""
        self.advance(when[0])
        is_held = self.state in (None, ENABLED) and self.session in (None, part["session"])
        is_newer = is_newer_token(part["token"], self.token or 0)
        if is_held and is_newer and self.sets.keep(part, when):
            self.fed = when

    def part_refused(self, part: Values, code: str) -> None:
        """Apply the rejection of a set's last part, according to the code."""
        if code not in _NOT_LOOKED_AT:
            self.sets.refused(part)

    def _commit(self, commit: Values, when: Interval) -> None:
        token = commit["token"]
        if token == self.token:
            return
        until = self.sets.staged_until(token)[1]
        if self.token is not None and until < when[0] - self.slack:
            seen = f"until {until:.4f} s" if until > -math.inf else "not staged"
            self.report(
                "token", when[1], f"set {token} that is committed", must="staged", seen=seen
            )
        self._play(token, when, self.clock.moment(commit["at"], when))

    def may_start(self, when: Interval) -> bool:
        """Return whether a set that waits, or has waited, can start within an interval."""
        if self._waiting is not None and when[1] >= self._waiting[0][0] - self.slack:
            return True
        return when[0] <= self._started + self.slack

    def _start_waiting(self, sooner: Interval = (math.inf, math.inf)) -> None:
        """Start the waiting set at its own time, or earlier if another set replaces it."""
        if self._waiting is not None:
            (early, late), token, layers, is_exact = self._waiting
            when, is_at_once = (min(early, sooner[0]), min(late, sooner[1])), sooner[0] < late
            self._waiting, self._started = None, when[1]
            self.outputs.play(layers, token, when, is_exact=is_exact, is_at_once=is_at_once)

    def _play(self, token: int, when: Interval, moment: Interval | None = None) -> None:
        """Play a set from some time in an interval, or from a given time, unless it is playing."""
        if token == self.token:
            return
        self._start_waiting(when)
        layers, self.token = self.sets.whole(token), token
        if layers is None:
            self.outputs.forget()
            return
        if moment is None:
            self.outputs.play(layers, token, when, is_exact=self.sets.is_exact)
        else:
            self._waiting = moment, token, layers, self.sets.is_exact
        self.sets.drop()

    # Statuses

    def check(self, shown: Values, when: Interval) -> None:
        """Compare a status that was true at some time in an interval."""
        self.advance(when[0])
        self.outputs.may_derate = shown["temperature"] >= _WARM
        if not self.note_state(shown, when):
            self._adopt(shown, when)
            return
        end, cause = when[1], self.outputs.cause
        if self.token is not None:
            self._expect("token", end, f"token after {cause}", self.token, shown["token"])
        self.token = shown["token"]
        left = shown["watchdog_left"] / 1000
        slack = self._left_slack + self.slack
        low = self.watchdog - (end - self.fed[0]) - slack if self.is_enabled else 0.0
        high = self.watchdog - (when[0] - self.fed[1]) + slack if self.is_enabled else 0.0
        is_unknown = self.is_enabled and self.watchdog == math.inf
        if not (low <= left <= max(high, 0.0) or is_unknown):
            must = f"{low:.6g} to {high:.6g}"
            self.report("watchdog", end, f"watchdog_left after {cause}", must=must, seen=left)
        self.clock.check(shown["clock"], when)
        if not self.may_start(when):
            self.outputs.check(shown, when)
        self._check_voltage(shown, when)
        self.last_status = when[0]

    def note_state(self, shown: Values, when: Interval) -> bool:
        """Compare state, fault and latch, and adopt them; returns whether the state is possible."""
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
            self.fault = fault  # a fault before the watchdog expired that was not observed
            self._faults[0] = fault, (self.last_status, end)
        rule, cause = "latched" if now in LATCHED else "state", self.outputs.cause
        self._expect(rule, end, f"fault after {cause}", self.fault, fault)
        if self.latch is not None:
            self._expect("latched", end, f"latch after {cause}", self.latch, latch)
        self.state, self.fault, self.latch, self.is_shown = now, fault, latch, True
        return True

    def _adopt(self, shown: Values, when: Interval) -> None:
        """Adopt a status without comparing it."""
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
        self.token = shown.get("token", self.token)
        self.is_shown, self.last_status = True, when[0]

    def _states(self, when: Interval) -> list[int]:
        """Return the states in which the amplifier can be during an interval."""
        here = self.state or 0
        if here not in _FALLING:
            return [0, OFF] if here == STATES["NOT_READY"] else [here]
        states = [] if self._is_silent(when) else [here]
        if when[1] > self.silent[0] - ROUNDED - self.slack:
            states.append(_FALLING[here])
        return states

    def _is_silent(self, when: Interval) -> bool:
        """Return whether it must have been silent, and report so, during an interval."""
        return when[0] > self.silent[1] + _SETTLING + ROUNDED + self.slack

    def _rule_against(self, now: int) -> str:
        """Return the rule that a state violates."""
        if not self.is_shown:
            return "watchdog" if now == ENABLED else "latched"
        if now == ENABLED:
            return "armed"
        return "latched" if self.state in LATCHED else "state"

    def _tripped(self, fault: int, when: Interval) -> None:
        """Check a transition into a fault: the watchdog must not trip early."""
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
        """Return the interval in which the watchdog tripped, if it had tripped by `time`."""
        early, late = self.expiry
        first = min(max(early, self.last_status), time)
        return first, max(min(late, time), first)

    def _check_voltage(self, shown: Values, when: Interval) -> None:
        """Check high voltage, and the interlock if the amplifier has one."""
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
        """Check a fault list: newest first, all observed faults, with their ages."""
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

    def _check_achieved(self, number: int, reply: Values, when: Interval) -> None:
        """Compare the achieved values of a layer with its commands."""
        outputs = self.outputs
        if self.may_start(when) or not (sure := outputs.sure(when)):
            return
        possible = outputs.tokens_of(number, sure)
        problem: Problem | None = None
        if reply["token"] not in possible:
            problem = "token", "token", one_of(possible), reply["token"]
        elif number in sure:
            problem = achieved_problem(
                outputs.playback.playing(number),
                reply,
                self.can,
                is_exact=outputs.is_exact,
                can_scale=outputs.may_derate or not outputs.is_exact,
            )
            lasting = outputs.lasting.get(number, {0}) if reply["commands"] else {0}
            rows = reply, *reply["commands"]
            flags = [name for row in rows for name in FLAGS if row.get(name)]
            if problem is None and flags:
                problem = "plays", "flags", [], flags
            if problem is None and reply["valid_for"] not in lasting:
                problem = "plays", "valid_for", sorted(lasting), reply["valid_for"]
            if problem is None and reply["ramp"] and not reply["commands"]:
                problem = "plays", "ramp of a silent layer", 0, reply["ramp"]
        if problem is not None:
            rule, what, must, seen = problem
            report = self.report if reply["commands"] else self.report_silence
            report(rule, when[1], f"{what} of achieved layer {number}", must=must, seen=seen)

    def report_silence(
        self, rule: str, time: float, what: str, *, must: object, seen: object
    ) -> None:
        """Report unexpected silence as a violation that a hidden fault could explain."""
        self.report(rule, time, what, must=must, seen=seen)
