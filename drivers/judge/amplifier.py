"""An amplifier as it must be after what it was sent: sessions, tokens, sets and what plays.

What it was sent was carried out at some time between the request and its reply, and what it shows
was true at some time between, so both are compared with all of that interval. Nothing is known at
first: the first status says how it is.
"""

import math
from typing import TypeAlias

from drivers.judge.clock import ExpectedClock
from drivers.judge.outputs import one_of
from drivers.judge.sets import ExpectedSet
from drivers.judge.states import (
    DISARMED,
    FADE,
    FAULT,
    REACTING,
    ROUNDED,
    STOPPED,
    SWITCHED_ON,
    ExpectedStates,
)
from drivers.playing.playback import Playback
from drivers.playing.uncertain import Interval
from drivers.protocol.definition import ENABLED, FAULTS, LATCHED, MESSAGES, QUANTITIES
from drivers.protocol.records import Values
from drivers.protocol.sets import FLAGS, TONE, LayerSet, Problem, achieved_problem, is_newer_token

_WARM = QUANTITIES["temperature"].to_wire(60.0)  # from here on an amplifier may derate
FEEDING = frozenset(name for name, message in MESSAGES.items() if message.feeds)
"""Requests that feed the watchdog unless they are refused."""
_ONLY_IN = {
    **dict.fromkeys(("Set", "Commit", "Silence"), (ENABLED,)),
    "SetAddress": DISARMED,
    "Arm": (*DISARMED, SWITCHED_ON, ENABLED),
}
"""States in which alone a request is accepted."""
_NOT_LOOKED_AT = "WRONG_SESSION", "WRONG_STATE", "BUSY"
"""Refusals of a part by what it does not hold."""
_Waiting: TypeAlias = tuple[Interval, int, tuple[LayerSet, ...], bool]
"""A committed set: its moment, token and layers, and whether it plays to the word."""


class ExpectedAmplifier(ExpectedStates):
    """One amplifier; token and session are None while unknown; times [s]."""

    def forget(self, cause: str = "what was not heard") -> None:
        """Treat all as unknown until the next status."""
        self.token: int | None = None
        self.session: int | None = None
        self.sets = ExpectedSet()
        self.clock = ExpectedClock(self.report, self.slack)
        self._waiting: _Waiting | None = None
        self._started = -math.inf  # by when a set that has waited has surely started
        super().forget(cause)

    @property
    def to_play(self) -> Playback:
        """What it plays, with the set that waits, from its moment on."""
        if self._waiting is None:
            return self.outputs.playback
        when, token, layers, _ = self._waiting
        playback = self.outputs.playback.copied()
        playback.commit(layers, token, sum(when) / 2)
        return playback

    # What it does

    def advance(self, time: float) -> None:
        """Apply what must have happened without a request until now."""
        if self.is_enabled and time > self.expiry[1] + ROUNDED + self.slack:
            self._trip(FAULTS["WATCHDOG"], self.expiry, "the watchdog")
            self.is_shown = False
        if self._waiting is not None and time > self._waiting[0][1] + self.slack:
            self._start_waiting()

    def _fall_silent(
        self, state: int, when: Interval, ramp: float, cause: str, *, has_floor: bool = True
    ) -> None:
        self.sets.drop()
        if self.may_start(when):  # so that what falls silent is unknown
            self.outputs.forget()
        self._waiting = None
        super()._fall_silent(state, when, ramp, cause, has_floor=has_floor)

    def granted(self, name: str, values: Values, reply: Values, when: Interval) -> None:
        """Apply a request that was carried out between two times, and compare its reply."""
        self.advance(when[0])
        self._check_allowed(name, values, when[1])
        is_late = reply.get("state") in (REACTING, FAULT)  # it may have expired before
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
        """Only the session that is held plays and feeds; nothing plays unless armed."""
        session, token = values.get("session"), values.get("token", 0)
        if name in FEEDING and self.is_enabled and self.session not in (None, session):
            self.report("session", time, f"session of {name}", must=self.session, seen=session)
        if self.token and token not in (0, self.token) and not is_newer_token(token, self.token):
            must = f"newer than {self.token}"
            self._always("token", time, f"token of {name}", must=must, seen=token)
        if self.state not in (None, *_ONLY_IN.get(name, (self.state,))):
            rule = "latched" if name == "Arm" else "state" if name == "SetAddress" else "enabled"
            rule = rule if self.is_shown else "watchdog"
            what = f"answer to {name} in {self._name_of(self.state)}"
            self.report(rule, time, what, must="WRONG_STATE", seen="carried out")

    def carry_out(self, name: str, values: Values, shown: Values, when: Interval) -> None:
        """Apply a request carried out between two times, as its reply or a later status shows."""
        ramp = min(values.get("ramp", 0), self.can.get("ramp_max", math.inf)) / 1000
        cause = f"{name} {values}"
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

    # Sets

    def _take(self, part: Values, reply: Values, when: Interval) -> None:
        """Compare the reply to a part of a set, and play a set that is played at once."""
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
        """Apply a part of a set but the last, which is kept or dropped without a word."""
        self.advance(when[0])
        is_held = self.state in (None, ENABLED) and self.session in (None, part["session"])
        is_newer = is_newer_token(part["token"], self.token or 0)
        if is_held and is_newer and self.sets.keep(part, when):
            self.fed = when

    def part_refused(self, part: Values, code: str) -> None:
        """Apply a refusal of the last part of a set, by its code."""
        if code not in _NOT_LOOKED_AT:
            self.sets.refused(part)

    def _commit(self, commit: Values, when: Interval) -> None:
        token = commit["token"]
        if token == self.token:
            return
        until = self.sets.staged_until(token)[1]
        if self.token is not None and until < when[0] - self.slack:
            seen = f"until {until:.4f} s" if until > -math.inf else "not staged"
            what = f"set {token} that is committed"
            self.report("token", when[1], what, must="staged", seen=seen)
        self._play(token, when, self.clock.moment(commit["at"], when))

    def _start_waiting(self, sooner: Interval = (math.inf, math.inf)) -> None:
        """Start the set that waits at its moment, or sooner before another one."""
        if self._waiting is not None:
            (early, late), token, layers, is_exact = self._waiting
            when, is_at_once = (min(early, sooner[0]), min(late, sooner[1])), sooner[0] < late
            self._waiting, self._started = None, when[1]
            self.outputs.play(layers, token, when, is_exact=is_exact, is_at_once=is_at_once)

    def _play(self, token: int, when: Interval, moment: Interval | None = None) -> None:
        """Play a set between two times or from a moment on, unless it is the one that plays."""
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

    # What it shows

    def check(self, shown: Values, when: Interval) -> None:
        """Compare a status that was true at some time between two."""
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

    def may_start(self, when: Interval) -> bool:
        """Whether a set that waits, or has waited, may start within an interval."""
        if self._waiting is not None and when[1] >= self._waiting[0][0] - self.slack:
            return True
        return when[0] <= self._started + self.slack

    def _adopt(self, shown: Values, when: Interval) -> None:
        """Go on with a status as it is."""
        super()._adopt(shown, when)
        self.token = shown.get("token", self.token)

    def _check_achieved(self, number: int, reply: Values, when: Interval) -> None:
        """Compare what a layer plays with what it must."""
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
        """Take silence where there must be none, which a fault that is not shown would explain."""
        self.report(rule, time, what, must=must, seen=seen)
