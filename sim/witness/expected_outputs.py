"""What an amplifier must play: sets as they were sent to it and what it says of them, its channels.

A commit came at some time between its request and its reply (`drivers.uncertain_playback`).
"""

import math
from collections.abc import Mapping, Sequence
from itertools import pairwise

from drivers.playback import Playback
from drivers.protocol.records import Refusal, Values
from drivers.protocol.sets import Assembly, LayerSet, unpack_layers
from drivers.protocol.table import QUANTITIES, STAGED_LIFE
from drivers.uncertain_playback import Interval, UncertainPlayback
from sim.witness.capture import ReportViolation
from sim.witness.decoded import Request

_TURN = 36000  # of the wire; phases are modulo this
_DERATED = 0.01  # by which the shares of a derated set may differ


class SetReplies:
    """The set under way to one amplifier; times [s].

    is_exact: the set that is staged plays to the word, as the amplifier says.
    """

    def __init__(self) -> None:
        self.is_exact = True
        self._parts = Assembly()
        self._whole: tuple[int, tuple[LayerSet, ...]] = (0, ())  # token, and layers
        self._taken: set[int] = set()  # parts that have their reply
        self._taken_of = 0
        self._began = -math.inf  # of the first part, at the earliest
        self._staged = 0  # token

    def drop(self) -> None:
        """Discard what is staged."""
        self._staged, self._taken, self._taken_of = 0, set(), 0

    def sent(self, request: Request, time: float) -> str:
        """Note a part of a set that is sent; returns what is wrong with it, or ""."""
        if request.name != "Set":
            return ""
        try:
            stream = self._parts.add(request.values, time, QUANTITIES["set_words"].maximum)
            if stream is not None:
                self._whole = request.values["token"], unpack_layers(stream)
        except Refusal as refusal:
            return str(refusal)
        return ""

    def whole(self, token: int) -> tuple[LayerSet, ...] | None:
        """Return the layers of a set, all parts of which were sent."""
        return self._whole[1] if token == self._whole[0] else None

    def is_staged(self, token: object, time: float = -math.inf) -> bool:
        """Whether a set is staged, and kept until a time at least."""
        return bool(self._staged) and token == self._staged and time <= self._began + STAGED_LIFE

    def taken(
        self, part: Values, reply: Values, when: tuple[float, float], *, is_committed: bool
    ) -> str:
        """Compare the reply to a part; returns what is wrong with it. is_committed: before."""
        token = part["token"]
        if token != self._taken_of:
            self._taken, self._taken_of, self._began = set(), token, when[0]
        self._taken.add(part["index"])
        is_whole = self.whole(token) is not None
        is_kept, is_played = bool(reply["staged"]), bool(reply["played"])
        self.is_exact = bool(reply["exact"])
        self._staged = token if is_kept else 0
        problem = ""
        if (is_kept or is_played) and not is_whole:
            problem = "accepted before all of its parts"
        elif is_played != (bool(part["now"]) and is_whole) and not is_committed:
            problem = "played" if is_played else "not played"
        elif len(self._taken) == part["parts"] and not (is_kept or is_played):
            problem = "not staged, though it is whole"
        elif not (is_kept or is_played) and reply["missing"] in self._taken:
            problem = f"misses part {reply['missing']}, which it took"
        return problem if when[1] < self._began + STAGED_LIFE else ""


def achieved_problem(
    expected: LayerSet, token: int, reply: Values, *, can_scale: bool
) -> tuple[str, str] | None:
    """Return the rule that a reply to GetAchieved breaks, and how; None if it agrees.

    can_scale: all levels may be lower by one factor.
    """
    if reply["token"] != token:
        return "token", f"token must be {token}, got {reply['token']}"
    played = {each["channel"]: each for each in reply["commands"]}
    commands = {each.channel: each for each in expected.commands}
    if played.keys() != commands.keys():
        return "commit", f"channels must be {sorted(commands)}, got {sorted(played)}"
    shares: dict[int, float] = {}
    for channel, command in commands.items():
        got = played[channel]
        turned = (got["phase"] - command.phase + _TURN // 2) % _TURN - _TURN // 2
        is_same = abs(got["frequency"] - command.frequency) <= 1 and abs(turned) <= 1
        if not is_same or (abs(got["level"] - command.level) > 1 and not can_scale):
            return "plays", f"channel {channel} must play {command}, got {got}"
        if command.level:
            shares[command.level] = got["level"] / command.level
    if shares and max(shares.values()) - min(shares.values()) > _DERATED + 1 / min(shares):
        return "commit", "its channels are scaled differently"
    return None


LEVEL = 0.002
"""Tolerance of levels, in full levels: rounding, and the last step of a fade."""
_RAMP, _VOICES = QUANTITIES["ramp"], QUANTITIES["voices"]
_FINE = 0.026  # Hz; half a step of the wire
_MAX_ENDING = 3.3  # s; 32 knots, 0.1 s apart
_FRACTIONS = 16  # of a transition at which sums are looked at


def silent() -> Playback:
    """Return a silent playback with all the channels and voices that there can be.

    No fade is cut short in it, so that its levels are upper bounds.
    """
    return Playback(QUANTITIES["channel_count"].maximum, _VOICES.maximum)


class ExpectedOutputs:
    """The channels of one amplifier; times [s].

    voices: of a channel, as the amplifier states them; cause: of what plays, for messages; is_warm:
    it may derate. report: takes what it does, without its name.
    """

    def __init__(self, *, slack: float, report: ReportViolation) -> None:
        self.voices = _VOICES.minimum
        self.is_warm = False
        self._slack = slack
        self._report = report
        # Silence where there must be none, which an unreported fault would explain.
        self._suspicions: list[tuple[str, float, str]] = []
        self.settle("nothing")

    def settle(self, cause: str) -> None:
        """Treat all channels as silent, their fades over."""
        self._plays = UncertainPlayback(silent())
        self.cause = cause
        self.is_exact = True
        # Until when what a layer plays is not known [s].
        self._unknown = [-math.inf] * QUANTITIES["layer_count"].maximum
        self._before: Sequence[float] = ()  # levels of channels before the last commit
        self._last_due = -math.inf
        self._uncertain_until = -math.inf  # fades may have been cut short
        self._highest = 0.0  # of the sums of a channel since the last status, at most

    def forget(self) -> None:
        """Treat what plays as unknown."""
        self.settle("what was not heard")
        self._unknown = [math.inf] * len(self._unknown)

    # what happens

    @property
    def playback(self) -> Playback:
        """What plays, with each commit in the middle of its interval."""
        return self._plays.playback

    def _advance(self, time: float) -> None:
        """End layers and start what waits, where that must have happened by a time."""
        due = self.playback.next_due
        self._plays.advance(time - self._slack)
        if self.playback.next_due != due:
            self._last_due = due

    def play(self, layers: Sequence[LayerSet], token: int, when: Interval, *, exact: bool) -> None:
        """Play a set from some time between two on."""
        begin, end = when
        self._advance(begin)
        self._before = [*map(self.playback.settled, range(self.playback.channels))]
        for one in layers:
            number, ends = one.layer, self.playback.end_of(one.layer)
            half = self._plays.half[number]
            is_ending = begin - half <= ends <= end + half
            if is_ending and (one.renew or any(each.keep_phase for each in one.commands)):
                self._unknown[number] = math.inf
            elif not one.renew and not one.after:
                fade = end + _MAX_ENDING + _RAMP.from_wire(one.ramp)
                self._unknown[number] = min(self._unknown[number], fade)
        self._plays.commit(layers, token, when)
        self.cause, self.is_exact = "a set", exact and self.is_exact
        for channel, each in enumerate(self.playback.all_voices):
            self._highest = max(self._highest, self.playback.peak(channel, begin))
            fades = [voice.silent_from for voice in each if voice.has_ended]
            if len(each) > self.voices and fades:
                self._uncertain_until = max(self._uncertain_until, *fades)

    def silence(self, when: Interval, ramp: float, cause: str) -> None:
        """Silence all channels along a ramp [s], from some time between two on."""
        self._advance(when[0])
        self._plays.silence(when, ramp)
        self._unknown = [min(until, when[1] + ramp) for until in self._unknown]
        self.cause = cause

    @property
    def _lag(self) -> float:
        """Longest time by which a transition under way may be earlier or later [s]."""
        return self._plays.lag + self._slack

    # what is reported

    def is_quiet(self, begin: float, end: float) -> bool:
        """Go on to a time, and return whether all layers are known from it to another one.

        None ends or starts by itself near these.
        """
        half = self._lag
        self._advance(begin)
        is_known = all(until < begin for until in self._unknown)
        is_due = self.playback.next_due <= end + half or self._last_due >= begin - half
        vanish = any(  # onsets that lead to silence
            not voice.has_ended and begin - half <= voice.silent_from <= end + half
            for voices in self.playback.all_voices
            for voice in voices
        )
        return is_known and not is_due and not vanish

    def _bounds(self, channel: int, begin: float, end: float) -> Interval:
        """Return the least and the largest sum of a channel between two times."""
        low, high = self._plays.bounds(channel, begin, end)
        return 0.0 if begin <= self._uncertain_until else low, high

    def check_levels(
        self, levels: Sequence[float], begin: float, end: float, *, may_be_off: bool,
        of_sensor: bool = False,
    ) -> None:  # fmt: skip
        """Report levels that are impossible at every time between two.

        may_be_off: whether the watchdog may have expired; of_sensor: levels that are too low wait
        for `resolve_suspicions`.
        """
        if not self.is_quiet(begin, end):
            return
        is_settled = self.playback.is_settled(begin - self._lag)
        can_be_low = self.is_warm or may_be_off or not self.is_exact
        for channel, level in enumerate(levels):
            low, high = self._bounds(channel, begin - self._slack, end + self._slack)
            is_low = level < min(low, 1.0) - LEVEL
            if level > min(high, 1.0) + LEVEL or (is_low and not can_be_low):
                wrong = f"at least {low:.4f}" if is_low else f"at most {high:.4f}"
                report = self.suspect if is_low and of_sensor else self._report
                report(
                    self._rule_of_level(channel, level, is_settled=is_settled),
                    end,
                    f"has level {level:.4f} on channel {channel}, must be {wrong} after "
                    f"{self.cause}",
                )

    def _rule_of_level(self, channel: int, level: float, *, is_settled: bool) -> str:
        if self.cause == "the watchdog":
            return "watchdog"
        if not is_settled:
            return "ramp"
        if self.cause != "a set":
            return "silent"
        before = self._before[channel] if channel < len(self._before) else 0.0
        return "commit" if abs(level - before) < LEVEL else "plays"

    def check_limited(self, begin: float, end: float, *, is_limited: bool) -> None:
        """Compare whether a sum was limited since the last status, and begin anew."""
        channels = range(self.playback.channels)
        since, until = begin - self._slack, end + self._slack
        if self.is_quiet(begin, end):
            low = max(self._bounds(channel, since, until)[0] for channel in channels)
            if is_limited and self._highest < 1:
                self._report("plays", end, "reports a sum as limited, none exceeds full level")
            elif low > 1 + LEVEL and self.is_exact and not (self.is_warm or is_limited):
                self._report("plays", end, "does not report that a sum is limited")
        self._highest = max(self.playback.peak(channel, since) for channel in channels)

    def suspect(self, rule: str, time: float, what: str) -> None:
        """Note a violation that is none if the amplifier has a fault, as its next status says."""
        self._suspicions.append((rule, time, what))

    def resolve_suspicions(self, *, is_enabled: bool) -> None:
        """Report suspicions, unless a fault explains them."""
        for suspicion in self._suspicions if is_enabled else ():
            self._report(*suspicion)
        self._suspicions.clear()

    def check_frequencies(self, measured: Mapping[int, float], time: float) -> None:
        """Compare the frequency [Hz] that a channel vibrates with, where it must have settled."""
        if not self.is_quiet(time, time):
            return
        for channel, frequency in measured.items():
            voices = self.playback.voices_of(channel)
            lasting = sorted({each.frequency for each in voices if not each.has_ended})
            is_settled = all(each.transition.end < time - self._lag for each in voices)
            if lasting and is_settled and all(abs(each - frequency) > _FINE for each in lasting):
                what = f"vibrates at {frequency:g} Hz on channel {channel}, commanded {lasting} Hz"
                self._report("plays", time, what)

    def check_tokens(self, tokens: Sequence[int], begin: float, end: float) -> None:
        """Compare the token of each layer, where all are known."""
        expected = self.playback.tokens
        for layer, token in enumerate(tokens) if self.is_quiet(begin, end) else ():
            if token != expected.get(layer, 0):
                what = f"reports token {token} of layer {layer}, expected {expected.get(layer, 0)}"
                self._report("token", end, what)

    def note_silent(self, tokens: Sequence[int], time: float) -> None:
        """Note the layers that play nothing by a status at a time; they may still fade."""
        for layer, until in enumerate(self._unknown):
            if until == math.inf and (layer >= len(tokens) or not tokens[layer]):
                self._unknown[layer] = time + _MAX_ENDING + _RAMP.high

    def sums(self, time: float) -> tuple[Mapping[int, float], float, Mapping[int, float]]:
        """Return what follows from a time on: largest levels, power, and steepest rises.

        Levels and rises by channel, in full levels and full levels/s; looked at along the
        transitions under way.
        """
        times = {time}
        playing = {each: one for each, one in enumerate(self.playback.all_voices) if one}
        for way in [voice.transition for voices in playing.values() for voice in voices]:
            count = max(_FRACTIONS, len(way.knots) + 1)
            steps = range(count + 1)
            times.update(way.start + (way.end - way.start) * part / count for part in steps)
        moments = sorted({round(at, 6) for at in times if at >= time})  # no sums of floats
        levels, rises = dict[int, list[float]](), dict[int, float]()
        for channel, voices in playing.items():
            row = [sum(abs(each.transition.at(at)) for each in voices) for at in moments]
            steeps = zip(pairwise(row), pairwise(moments), strict=True)
            levels[channel] = row
            rises[channel] = max(((b - a) / (t - s) for (a, b), (s, t) in steeps), default=0.0)
        moment_by_moment = zip(*levels.values(), strict=True)
        power = max((sum(v * v for v in each) for each in moment_by_moment), default=0.0)
        return {channel: max(row) for channel, row in levels.items()}, power, rises
