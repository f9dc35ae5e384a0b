"""What an amplifier must show after what it was sent: states, latches, tokens, levels, watchdog.

What a channel plays is asked of `drivers.playback`. When a request was carried out is known as an
interval, so there are a few playbacks, whose sets were committed sooner or later within theirs.
"""

import math
from collections.abc import Mapping, Sequence

from drivers.conformance.client import When
from drivers.conformance.findings import expect, expect_equal, expect_one_of, expect_within
from drivers.playback import Playback, playback_of
from drivers.protocol.records import Values
from drivers.protocol.sets import LayerSet
from drivers.protocol.table import (
    FAULTS,
    MESSAGES,
    QUANTITIES,
    STAGED_LIFE,
    STATES,
    STATUS_FLAGS,
)
from drivers.protocol.tokens import token_after
from drivers.transition import Transition

SLACK = 0.002  # s; of times in milliseconds
DRIFT = 1e-3  # of a time; of the amplifier's clock
NAMES = {number: name for name, number in STATES.items()}
OFF, ENABLED, STOPPED = "SWITCH_ON_DISABLED", "OPERATION_ENABLED", "QUICK_STOP_ACTIVE"
_FALLING = {"SWITCHED_ON": ("SWITCHED_ON", OFF), "FAULT": ("FAULT_REACTION_ACTIVE", "FAULT")}
"""What is shown until all is silent, and then."""
_TRIP, FADE, _SETTLING = 0.005, 0.005, 0.01  # s; until a trip, of a fault, until a state shows
_LASTING = 3.0  # s; what ends after it is not awaited
_LATE = 0.002  # s; by which a set may begin later
_SHARES = ((0, 0), (0, 1), (1, 0), (0.5, 0.5))
"""Of the interval of a commit, for the sets of even and odd number of each playback."""
_POINTS, _POINT = 600, 2e-5  # at which an interval is looked at; s apart
_PER_TURN, _PER_FADE = 1000, 100  # points of a step that may pass 0, of a rise or fade
_TOLERANCE = 0.002  # of full level
_FULL = QUANTITIES["level"].per_unit


class Expected:
    """An amplifier since a status at rest; times [s] are intervals of this machine's clock.

    fed: when the watchdog was fed last. sets: by their tokens. is_exact: whether its levels show
    how tones of one frequency interfere.
    """

    def __init__(self, can: Values, rest: Values, when: When) -> None:
        self.can, self.latch, self.token = can, rest["latch"], rest["token"]
        self.state, self.fault = OFF, FAULTS["NONE"]
        self.session = 0
        self.sets: dict[int, tuple[LayerSet, ...]] = {}
        self.is_exact = False
        self.watchdog = 0.0
        self.fed = self.began = self.silent = self._first = when
        self.cause = "rest"
        self.tolerance = max(2 * can["level_step"] / _FULL, _TOLERANCE)
        self._has_floor = True  # or levels may be lower: of a fault, whose fade may be shorter
        self._playbacks = [playback_of(can) for _ in _SHARES]
        self._moments = [when.earliest] * len(_SHARES)
        self._count = self._incoming = 0
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
        if token != self._incoming or when.earliest > self._first.latest + STAGED_LIFE:
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
        self._start(when)
        for playback, moment in zip(self._playbacks, self._moments, strict=True):
            playback.commit(layers, token, moment)

    def _fall_silent(self, state: str, when: When, ramp: float, *, has_floor: bool = True) -> None:
        self.state, self._has_floor = state, has_floor
        self._incoming = 0
        self._start(when)
        ends = []
        for playback, moment in zip(self._playbacks, self._moments, strict=True):
            playback.silence(moment, ramp)
            ends.append(max(playback.ends_by, moment))
        self.silent = When(min(ends) if has_floor else when.earliest, max(ends))

    def _start(self, when: When) -> None:
        """Let something begin within an interval, in each playback at a moment of its own."""
        self.began, self._count = when, self._count + 1
        width = when.latest + _LATE - when.earliest
        shares = [both[self._count % 2] for both in _SHARES]
        moments = [when.earliest + share * width for share in shares]
        self._moments = [max(pair) for pair in zip(moments, self._moments, strict=True)]

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
            slack, what = self.tolerance, f"level of channel {channel}, {where}"
            expect_within(level, low - slack, high + slack, what)
        for number, known in enumerate(tokens):
            expect_one_of(shown["tokens"][number], known, f"token of layer {number}, {where}")

    def _played(self, when: When) -> tuple[list[tuple[float, float]], list[set[int]]]:
        """Return least and largest level of each channel, and possible tokens of each layer."""
        levels: list[list[float]] = [[] for _ in range(self.can["channels"])]
        tokens: list[set[int]] = [set() for _ in range(self.can["layers"])]
        for original, moment in zip(self._playbacks, self._moments, strict=True):
            playback = original.copied()
            passed = when.latest - self.began.earliest
            first = moment + when.earliest - self.began.latest - _LATE - DRIFT * passed
            last = moment + passed * (1 + DRIFT)
            moments = _moments_of(playback, max(first, moment), last)
            for time in moments:
                playback.advance(time)
                for channel, seen in enumerate(levels):
                    if playback.voices_of(channel):
                        seen += _levels(playback, channel, time, is_exact=self.is_exact)
                    else:
                        seen.append(0.0)
                if time in (moments[0], moments[-1]):
                    playing = playback.tokens
                    for number, known in enumerate(tokens):
                        known.add(playing.get(number, 0))
        return [(min(1.0, *each), min(1.0, max(each))) for each in levels], tokens

    def settled_at(self, now: float) -> float:
        """Return when all that plays lasts for long or is silent [s], as far as is known."""
        playback, last = self._playbacks[0].copied(), now + _LASTING
        while (due := playback.next_due) < last:
            playback.advance(due)
            now = due
        ends = [voice.transition.end for voices in playback.all_voices for voice in voices]
        return max([now, *ends])


def _moments_of(playback: Playback, first: float, last: float) -> Sequence[float]:
    """Return moments at which an interval is looked at: one where nothing changes."""
    if playback.is_settled(first) and playback.next_due > last:
        return (first,)
    apart = [
        each.transition.step / (_PER_TURN if _may_turn(each.transition) else _PER_FADE)
        for voices in playback.all_voices
        for each in voices
        if each.transition.end > first
    ]
    width = max(min(apart, default=math.inf), _POINT)
    count = min(math.ceil((last - first) / width) + 3, _POINTS)
    return [first + (last - first) * at / (count - 1) for at in range(count)]


def _may_turn(transition: Transition) -> bool:
    """Whether its amplitude may be least on its way, not at an end."""
    return bool(transition.knots or (transition.first and transition.last))


def _levels(
    playback: Playback, channel: int, time: float, *, is_exact: bool
) -> tuple[float, float]:
    """Return the least and largest level that a channel may show."""
    voices = playback.voices_of(channel)
    parts = [abs(voice.transition.at(time)) for voice in voices]
    highest = sum(parts)
    if is_exact:
        return (playback.level(channel, time),) * 2
    if len({voice.frequency for voice in voices}) == len(voices):
        return highest, highest
    if len({voice.origin for voice in voices}) == 1:
        return playback.level(channel, time), highest
    return max(2 * max(parts) - highest, 0.0), highest


def flag(status: Mapping[str, int], name: str) -> bool:
    """Whether a flag of a status is set."""
    return bool(status["flags"] >> STATUS_FLAGS[name] & 1)
