"""What an amplifier must show after what it was sent: states, latches, tokens, levels, watchdog.

What a channel plays is asked of `drivers.uncertain_playback`, since when a request was carried
out is known as an interval.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from drivers.conformance.client import (
    Late,
    When,
    expect,
    expect_equal,
    expect_one_of,
    expect_within,
)
from drivers.playback import playback_of
from drivers.protocol.records import Values
from drivers.protocol.sets import Command, LayerSet, token_after
from drivers.protocol.table import (
    FAULTS,
    MESSAGES,
    QUANTITIES,
    STAGED_LIFE,
    STATES,
    STATUS_FLAGS,
)
from drivers.uncertain_playback import UncertainPlayback

SLACK = 0.002  # s; of times in milliseconds
DRIFT = 1e-3  # of a time; of the amplifier's clock
NAMES = {number: name for name, number in STATES.items()}
OFF, ENABLED, STOPPED = "SWITCH_ON_DISABLED", "OPERATION_ENABLED", "QUICK_STOP_ACTIVE"
_TONE = "frequency", "level", "phase"
_FALLING = {"SWITCHED_ON": ("SWITCHED_ON", OFF), "FAULT": ("FAULT_REACTION_ACTIVE", "FAULT")}
"""What is shown until all is silent, and then."""
_TRIP, FADE, _SETTLING = 0.005, 0.005, 0.01  # s; until a trip, of a fault, until a state shows
_LASTING = 3.0  # s; what ends after it is not awaited
_LATE = 0.002  # s; by which a set may begin later
_TOLERANCE = 0.0015  # of full level
_MAX_STEPS = 4  # halves, beside one of each voice
_FULL, _HALF_CIRCLE = QUANTITIES["level"].per_unit, QUANTITIES["phase_step"].maximum


class Expected:
    """An amplifier since a status at rest; times [s] are intervals of this machine's clock.

    fed: when the watchdog was fed last. sets: by their tokens, as played where that is known;
    is_exactly: whether it plays them to the word. is_exact: whether its levels show
    how tones of one frequency interfere.
    """

    def __init__(self, can: Values, rest: Values, when: When) -> None:
        self.can, self.latch, self.token = can, rest["latch"], rest["token"]
        self.state, self.fault = OFF, FAULTS["NONE"]
        self.session = 0
        self.sets: dict[int, tuple[LayerSet, ...]] = {}
        self.is_exactly: dict[int, bool] = {}
        self.is_exact = False
        self.watchdog = 0.0
        self.fed = self.began = self.silent = self._first = when
        self.cause = "rest"
        self._half_step = can["level_step"] / 2 / _FULL
        self._has_floor = True  # or levels may be lower: of a fault, whose fade may be shorter
        self._plays = UncertainPlayback(playback_of(can))
        self._incoming = 0
        self._received: set[int] = set()

    # What it was sent

    def carried_out(self, name: str, values: Values, when: When) -> None:
        """Note a request that was carried out within an interval."""
        ramp = min(values.get("ramp", 0), self.can["ramp_max"]) / 1000
        if MESSAGES[name].feeds and self.state == ENABLED:
            self.fed = when
        if name == "Arm":
            self.watchdog, self.fed = values["watchdog"] / 1000, when
            if self.state != ENABLED or values["session"] != self.session:
                self.session, self.token = values["session"], 0
                self._fall_silent(ENABLED, when, FADE, has_floor=False)
        elif name == "Commit":
            self.commit(values["token"], when)
        elif name == "Silence":
            self._fall_silent(ENABLED, when, ramp)
        elif name == "Stop":
            self.latch = token_after(self.latch)
            self._fall_silent("FAULT" if self.fault else STOPPED, when, ramp)
        elif name == "Disarm":
            state = "SWITCHED_ON" if self.state == ENABLED else self.state
            self._fall_silent(state, when, ramp)
        elif name == "Clear" and when.latest >= self.silent.earliest and self.state != ENABLED:
            self.state, self.fault = OFF, FAULTS["NONE"]
        if name not in ("Set", "Ping", "GetStatus"):
            self.cause = f"{name} {values}"

    def taken(self, values: Values, shown: Values, when: When) -> None:
        """Note a part of a set, and require what its reply must say."""
        token, is_now = values["token"], bool(values["now"])
        if token == self.token:
            expect_equal((shown["token"], shown["played"]), (token, 1), "token, played of a repeat")
            return
        lived = when.earliest - self._first.latest, when.latest - self._first.earliest
        if token == self._incoming and lived[0] <= STAGED_LIFE <= lived[1]:
            raise Late("a part came as its set expired")
        if token != self._incoming or lived[0] > STAGED_LIFE:
            self._incoming, self._received, self._first = token, set(), when
        self._received.add(values["index"])
        missing = [each for each in range(values["parts"]) if each not in self._received]
        seen = tuple(shown[each] for each in ("token", "staged", "played", "missing"))
        required = token, not missing and not is_now, not missing and is_now, (*missing, 0)[0]
        what = f"token, staged, played, missing after part {values['index']} of a set"
        expect_equal(seen, required, what)
        if not missing and is_now:
            self.commit(token, when)

    def commit(self, token: int, when: When) -> None:
        """Note that a set was played within an interval, unless it is the one that plays."""
        if token == self.token:
            return
        layers = self.sets[token]
        self.token, self.cause = token, f"set {token} of layers {[one.layer for one in layers]}"
        self._incoming = 0
        self._has_floor = True
        self.began = when
        begins = self._begins_in(when, layers)
        self._plays.commit(layers, token, begins)

    def _fall_silent(self, state: str, when: When, ramp: float, *, has_floor: bool = True) -> None:
        self.state, self._has_floor = state, has_floor
        self._incoming = 0
        self.began = when
        begins = self._begins_in(when, None, ramp)
        self._plays.silence(begins, ramp)
        first, last = (
            max(self._plays.playback.ends_by + late, start)
            for late, start in zip((-self._plays.lag, self._plays.lag), begins, strict=True)
        )
        self.silent = When(first if has_floor else when.earliest, last)

    def _begins_in(
        self, when: When, layers: Sequence[LayerSet] | None, ramp: float = 0.0
    ) -> tuple[float, float]:
        """Return between which times begins what comes within an interval; raises Late."""
        begins = when.earliest, when.latest + _LATE
        if self._plays.is_ambiguous(begins, layers, ramp):
            raise Late("a request came as a layer ended by itself, or its onset")
        return begins

    def achieved(
        self, one: LayerSet, shown: Mapping[str, Any], *, is_exact: bool = False
    ) -> LayerSet:
        """Return a layer as it plays by a GetAchieved; raises Violation beyond half a step."""
        found = {each["channel"]: each for each in shown["commands"]}
        where = f"in layer {one.layer}"
        driven = {tone.channel for tone in one.commands if tone.is_driven}
        expect_equal(sorted(found.keys() - driven), [], f"channels achieved but not driven {where}")
        played = []
        for tone in one.commands:
            requested = {name: getattr(tone, name) for name in _TONE}
            shown_tone = found.get(tone.channel, {**requested, "level": 0})
            plays = {name: shown_tone[name] for name in _TONE}
            for name in _TONE:
                error = abs(plays[name] - requested[name])
                error = min(error, 2 * _HALF_CIRCLE - error) if name == "phase" else error
                allowed = 0.0 if is_exact else self._rounding(name, tone)
                what = f"error of achieved {name} of channel {tone.channel} {where}"
                expect_within(error, 0, allowed, what)
            played.append(replace(tone, **plays) if tone.channel in found else tone)
        return replace(one, commands=tuple(played))

    def _rounding(self, name: str, tone: Command) -> float:
        """Return by how much a part of a tone may be rounded: inwards at the limits."""
        limits, step = self.can["limits"][tone.channel], self.can[f"{name}_step"]
        if name != "phase":
            value = getattr(tone, name)
            low, high = limits.get(f"{name}_min", 0), limits[f"{name}_max"]
            if not low <= value - step / 2 <= value + step / 2 <= high:
                return float(step)
        return float(step / 2)

    # What it must show

    def check(self, shown: Values, when: When) -> None:
        """Require what a status must show that was read within an interval; raises Violation."""
        self._expect_state(NAMES.get(shown["state"], ""), shown, when)
        required = self.fault, self.latch, self.token
        seen = tuple(shown[name] for name in ("fault", "latch", "token"))
        expect_equal(seen, required, f"fault, latch, token after {self.cause}")
        left, low, high = shown["watchdog_left"] / 1000, 0.0, 0.0
        if self.state == ENABLED:
            low = self.watchdog - (when.latest - self.fed.earliest) - SLACK
            high = max(self.watchdog - (when.earliest - self.fed.latest) + SLACK, 0.0)
        expect_within(left, low, high, f"watchdog_left after {self.cause}")
        self._expect_played(shown, when)

    def _expect_state(self, state: str, shown: Values, when: When) -> None:
        if self.state == ENABLED:
            self._expect_watchdog(state, when)
        known = [self.state]
        is_silent = when.earliest > self.silent.latest + _SETTLING + SLACK
        if self.state in _FALLING:
            may_be_silent = when.latest > self.silent.earliest - SLACK
            falling, after = _FALLING[self.state]
            known = [falling] * (not is_silent) + [after] * may_be_silent
        what = f"state {when.earliest - self.began.latest:.3f} s after {self.cause}"
        expect_one_of(state, known, what)
        if self.state == "SWITCHED_ON":
            self.state = state
        is_on = flag(shown, "high_voltage")
        must_be = self.state in (ENABLED, "SWITCHED_ON")
        is_open = flag(shown, "interlock_open")
        expect(
            not (must_be and is_open), "interlock of one that is on", expected="closed", seen="open"
        )
        what = f"high_voltage in {state} after {self.cause}"
        expect(is_on == must_be or not (must_be or is_silent), what, expected=must_be, seen=is_on)

    def _expect_watchdog(self, state: str, when: When) -> None:
        """Require that the watchdog trips at its time, not before."""
        earliest = self.fed.earliest + self.watchdog * (1 - DRIFT) - SLACK
        latest = self.fed.latest + (self.watchdog + _TRIP) * (1 + DRIFT)
        seen = f"{state} after {when.earliest - self.fed.latest:.4f} s"
        limits = f"FAULT from {self.watchdog:.3f} to {self.watchdog + _TRIP:.3f} s after it was fed"
        has_tripped = state in ("FAULT", "FAULT_REACTION_ACTIVE")
        is_met = when.latest >= earliest if has_tripped else when.earliest <= latest + SLACK
        expect(is_met, f"state by the watchdog ({self.cause})", expected=limits, seen=seen)
        if has_tripped:
            self.cause = f"the watchdog tripped ({self.cause})"
            self.fault, self.latch = FAULTS["WATCHDOG"], token_after(self.latch)
            since = When(earliest, max(min(latest, when.latest), earliest))
            self._fall_silent("FAULT", since, FADE, has_floor=False)

    def _expect_played(self, shown: Values, when: When) -> None:
        bounds, tokens = self._played(when)
        after = 1e3 * (when.earliest - self.began.latest), 1e3 * (when.latest - self.began.earliest)
        where = f"{after[0]:.1f} to {after[1]:.1f} ms after {self.cause}"
        for channel, (low, high) in enumerate(bounds):
            level, low = shown["levels"][channel] / _FULL, low * self._has_floor
            voices = len(self._plays.playback.voices_of(channel))
            slack = max((_MAX_STEPS + voices) * self._half_step, _TOLERANCE)
            expect_within(level, low - slack, high + slack, f"level of channel {channel}, {where}")
        for number, known in enumerate(tokens):
            expect_one_of(shown["tokens"][number], known, f"token of layer {number}, {where}")

    def waits(self, when: When) -> bool:
        """Whether a set surely waits for the end of an onset, whenever within an interval."""
        return all(each.playback.waiting for each in self._plays.possible(*self._drifted(when)))

    def _drifted(self, when: When) -> tuple[float, float]:
        """Return an interval as the amplifier's clock may have it."""
        drift = DRIFT * (when.latest - self.began.earliest)
        return when.earliest - drift, when.latest + drift

    def _played(self, when: When) -> tuple[list[tuple[float, float]], list[set[int]]]:
        """Return least and largest level of each channel, and possible tokens of each layer."""
        start, end = self._drifted(when)
        states = [*self._plays.possible(start, end)]
        bounds = []
        for channel in range(self.can["channels"]):
            each = [one.bounds(channel, start, end, is_exact=self.is_exact) for one in states]
            low, high = min(low for low, _ in each), max(high for _, high in each)
            bounds.append((min(low, 1.0), min(high, 1.0)))
        after = states[-1].copied()
        after.advance(end + 2 * after.lag)
        tokens = [one.playback.tokens for one in (*states, after)]
        layers = range(self.can["layers"])
        return bounds, [{each.get(number, 0) for each in tokens} for number in layers]

    def settled_at(self, now: float) -> float:
        """Return when all that plays lasts for long or is silent [s], as far as is known."""
        playback, last = self._plays.playback.copied(), now + _LASTING
        while (due := playback.next_due) < last:
            playback.advance(due)
            now = due
        ends = [voice.transition.end for voices in playback.all_voices for voice in voices]
        return max([now, *ends])


def flag(status: Mapping[str, int], name: str) -> bool:
    """Whether a flag of a status is set."""
    return bool(status["flags"] >> STATUS_FLAGS[name] & 1)
