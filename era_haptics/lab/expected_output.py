"""Expected outputs and clock of an amplifier after sets whose start is known only as an interval.

A set starts at some time between its commit and the reply, or slightly later. The playback places
each commit in the middle of its interval. Every transition has a half-width of its start time and a
radius by which its first amplitude can differ (`Tolerance`). Times [s] refer to any clock.
"""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from itertools import chain
from typing import NamedTuple, Protocol, TypeAlias

from drivers.playing import LAYERS_MAX, Playback, playback_of
from drivers.protocol.definition import (
    HIGH_STEPS,
    MAX_AHEAD,
    QUANTITIES,
    ahead,
    has_flag,
    high_word,
)
from drivers.protocol.records import Values
from drivers.protocol.sets import LayerSet
from drivers.voices import Voice, VoiceTransition

Interval: TypeAlias = tuple[float, float]
_PER_LEVEL = QUANTITIES["level"].per_unit
_PER_RAMP, _PER_VALID_FOR = QUANTITIES["ramp"].per_unit, QUANTITIES["valid_for"].per_unit


class Tolerance(NamedTuple):
    """How uncertain a transition is."""

    transition: VoiceTransition
    half: float
    """Half-width of its start time [s]."""
    radius: float
    """How far its first amplitude can differ."""


class UncertainPlayback:
    """Bounds of channel outputs; playback: places each commit in the middle of its interval.

    half: half-width of the time at which a layer ends or starts on its own.
    """

    def __init__(self, playback: Playback) -> None:
        self.playback = playback
        self.half = [0.0] * LAYERS_MAX
        # Replaced transitions by channel, and until when [s] they can still play.
        self._ghosts: list[tuple[int, VoiceTransition, float]] = []
        # Of transitions whose start is uncertain, by identity.
        self._tolerances: dict[int, Tolerance] = {}

    def tolerance_of(self, transition: VoiceTransition) -> Tolerance:
        """Return the tolerance of a transition."""
        return self._tolerances.get(id(transition)) or Tolerance(transition, 0.0, 0.0)

    @property
    def lag(self) -> float:
        """Largest half-width of a running transition's start time [s]."""
        voices = chain.from_iterable(self.playback.all_voices)
        halves = [self.tolerance_of(voice.transition).half for voice in voices]
        return max(*self.half, *halves, 0.0)

    def is_ambiguous(
        self, when: Interval, layers: Sequence[LayerSet] | None = None, ramp: float = 0.0
    ) -> bool:
        """Return whether a spontaneous change can coincide with a requested one.

        layers: of a set; None: all layers fade along a ramp [s].
        """
        if self.shortened_by(when, layers, ramp) > -math.inf:
            return True
        changed = dict.fromkeys(range(LAYERS_MAX), False)
        if layers is not None:
            changed = {one.layer: one.after for one in layers}
        # (time, half-width) of spontaneous changes, which the playback places before or after the
        # request.
        ends = [(due, self.half[layer]) for due, layer in self.playback.dues]
        ends += [(self.playback.end_of(layer), self.half[layer]) for layer in changed]
        by_then = self._by(when[0])
        waiting = {one.layer for one in by_then.waiting}
        for voice in chain.from_iterable(by_then.all_voices):
            way = voice.transition
            is_followed = voice.layer in waiting or changed.get(voice.layer, False)
            is_due = not way.last or (is_followed and bool(way.knots))
            if not voice.has_ended and voice.layer in changed and is_due:
                ends.append((way.end, self._half_of(voice)))
        return any(when[0] - half <= end <= when[1] + half for end, half in ends)

    def shortened_by(
        self, when: Interval, layers: Sequence[LayerSet] | None, ramp: float = 0.0
    ) -> float:
        """Return until when [s] it is unclear whether a ramp shortens an ending.

        This happens if the ending and the ramp end almost simultaneously; minus infinity if none
        do. layers, ramp: see `is_ambiguous`.
        """
        left = dict.fromkeys(range(LAYERS_MAX), ramp)
        if layers is not None:
            left = {one.layer: self._ends_after(one) for one in layers}
        latest = -math.inf
        for voice in chain.from_iterable(self._by(when[0]).all_voices):
            way, half, after = voice.transition, self._half_of(voice), left.get(voice.layer, 0.0)
            goes_on = way.last or not way.step or (layers is not None and voice.has_ended)
            if after and not goes_on and when[0] - half <= way.end - after <= when[1] + half:
                latest = max(latest, way.end + half, when[1] + after)
        return latest

    def _by(self, time: float) -> Playback:
        """Return the playback with everything carried out that is due by a time."""
        by_then = self.playback.copied()
        while (due := by_then.next_due) <= time:
            by_then.advance(due)
        return by_then

    def _half_of(self, voice: Voice) -> float:
        """Return the half-width of the time at which a voice ends."""
        return max(self.tolerance_of(voice.transition).half, self.half[voice.layer])

    def _ends_after(self, one: LayerSet) -> float:
        """Return how long a layer takes to fall silent after a set that ends it [s]."""
        if not one.renew:
            return one.ramp / _PER_RAMP
        return self.playback.ramp_of(one.layer) + one.valid_for / _PER_VALID_FOR

    def commit(self, layers: Sequence[LayerSet], token: int, when: Interval) -> None:
        """Play a set from some time in an interval."""
        half = (when[1] - when[0]) / 2
        self.advance(when[0])
        self._pass_until(when[0] + half)
        for one in layers:
            known = self.half[one.layer]
            onset_by = self.playback.onsets_end(one.layer, -math.inf) + known
            # A waiting set starts when the onset ends, whenever the onset is renewed.
            is_kept = one.after or (one.renew and onset_by > when[0])
            self.half[one.layer] = max(half, known if is_kept else 0.0)
        before = [*self.playback.all_voices]
        self.playback.commit(layers, token, when[0] + half)
        self._mark(before, when)

    def silence(self, when: Interval, ramp: float) -> None:
        """Fade all layers along a ramp [s], from some time in an interval."""
        middle = (when[0] + when[1]) / 2
        self.advance(when[0])
        self._pass_until(middle)
        before = [*self.playback.all_voices]
        self.playback.silence(middle, ramp)
        self._mark(before, when)

    def advance(self, time: float) -> None:
        """End layers and start waiting sets that must have done so by a time."""
        certain = time - self.lag
        self._pass_until(certain)
        self.playback.advance(certain)

    def _pass_until(self, time: float) -> None:
        """Carry out everything due by a time."""
        while (due := self.playback.next_due) <= time:
            half, before = max(self.half), [*self.playback.all_voices]
            self.playback.advance(due)
            self._mark(before, (due - half, due + half))

    def unsure(self, start: float, end: float) -> set[int]:
        """Return the layers that can end or start on their own in an interval."""
        self.advance(start)
        unsure = {layer for due, layer in self.playback.dues if due - self.half[layer] <= end}
        for voice in chain.from_iterable(self.playback.all_voices):
            transition = voice.transition
            is_falling = not (transition.last or voice.has_ended)
            if is_falling and transition.end - self.tolerance_of(transition).half <= end:
                unsure.add(voice.layer)
        return unsure

    def _mark(self, before: Sequence[Sequence[Voice]], when: Interval) -> None:
        """Note the tolerance of every new transition, and the replaced transitions."""
        half = (when[1] - when[0]) / 2
        ghosts = [ghost for ghost in self._ghosts if ghost[2] > when[0]]
        tolerances = [self.tolerance_of(transition) for _, transition, _ in ghosts]
        for channel, former_voices in enumerate(before):
            former_transitions = [voice.transition for voice in former_voices]
            former_ids = {id(transition) for transition in former_transitions}
            replaced = dict(zip(map(_key_of, former_voices), former_transitions, strict=True))
            for voice in self.playback.all_voices[channel]:
                transition = voice.transition
                former = replaced.pop(_key_of(voice), None)
                if id(transition) in former_ids:
                    tolerances.append(self.tolerance_of(transition))
                else:
                    radius = 0.0 if former is None else self.radius_of(former, *when)
                    tolerances.append(Tolerance(transition, half, radius))
            for transition in replaced.values():
                tolerance = self.tolerance_of(transition)
                is_cut = transition.last or transition.end > (when[0] + when[1]) / 2
                until = when[1] if is_cut else transition.end + tolerance.half
                if until > when[0]:
                    ghosts.append((channel, transition, until))
                    tolerances.append(tolerance)
        self._ghosts = ghosts
        self._tolerances = {id(tolerance.transition): tolerance for tolerance in tolerances}

    def bounds(self, channel: int, start: float, end: float, *, is_exact: bool = False) -> Interval:
        """Return the lowest and the highest level of a channel during an interval.

        A layer that can end or start in the interval counts from zero to its peak. is_exact: tones
        of one frequency interfere; otherwise their amplitudes can add up.
        """
        unsure = self.unsure(start, end)
        lowest = highest = extra = 0.0
        began = start - 3 * self.lag  # or later; layer, set and transition have separate clocks
        for one in self.playback.waiting:
            tones = [each for each in one.commands if each.channel == channel]
            for tone in tones if one.layer in unsure else ():
                extra += tone.peak / _PER_LEVEL
        groups: dict[float, list[VoiceTransition]] = {}
        for voice in self.playback.all_voices[channel]:
            if voice.layer in unsure and not voice.has_ended:
                extra += voice.peak(began) + self.tolerance_of(voice.transition).radius
                continue
            groups.setdefault(voice.frequency, []).append(voice.transition)
        for ways in groups.values():
            amplitudes = [_reached(way, (start + end) / 2) for way in ways]
            radius = sum(self.radius_of(way, start, end) for way in ways)
            level, added = abs(sum(amplitudes)), sum(map(abs, amplitudes))
            lowest += max(level - radius, 0.0)
            highest += (level if is_exact else added) + radius
        for at, way, until in self._ghosts:
            if at == channel and until > start:
                tolerance = self.tolerance_of(way)
                extra += abs(_reached(way, start - tolerance.half)) + tolerance.radius
        return max(lowest - extra, 0.0), highest + extra

    def radius_of(self, transition: VoiceTransition, start: float, end: float) -> float:
        """Return how far an amplitude can differ from that in the middle of an interval.

        Its transition has begun by then.
        """
        tolerance = self.tolerance_of(transition)
        center = _reached(transition, (start + end) / 2)
        since = max(start - tolerance.half, transition.start)
        until = max(end + tolerance.half, transition.start)
        distances = [abs(point - center) for point in transition.points(since, until)]
        if not tolerance.radius:
            return max(distances)
        # The effect of the first amplitude decays along its transition.
        decay = replace(
            transition, first=tolerance.radius, last=0, knots=(0j,) * len(transition.knots)
        )
        return max(distances) + abs(decay.at(since))


def _key_of(voice: Voice) -> tuple[int, float, float]:
    """Return values that a voice keeps while its transitions change."""
    return voice.layer, voice.frequency, voice.began


def _reached(way: VoiceTransition, time: float) -> complex:
    """Return the amplitude at a time, or at the start of a transition that begins later."""
    return way.at(max(time, way.start))


LATE, SAMPLE = (
    0.002,
    0.0001,
)  # s; delay of a set that plays immediately, and of one with a start time
DRIFT = 1e-3
"""Relative drift of the amplifier's clock."""
_TOLERANCE = 0.0015  # of full level; rounding, and the last step of a fade
_MAX_STEPS = 4  # of half a level step, in addition to one per voice
_MAX_ENDING = 3.3  # s; 32 knots, 0.1 s apart
_PERIOD = 0.1  # s; a sum of tones reaches its peak within this time
_LASTING = 3.0  # s; later endings are not awaited
_AMBIGUOUS = "a request arrived while a layer or its onset was ending"
_RAMP, _LEVEL = QUANTITIES["ramp"], QUANTITIES["level"]
_LAYERS, _VOICES = QUANTITIES["layer_count"].maximum, QUANTITIES["voices"].maximum
_ALL_LAYERS = {*range(_LAYERS)}


class ReportMismatch(Protocol):
    """Receives a violation: rule, time [s], name, expected and seen value."""

    def __call__(self, rule: str, time: float, what: str, *, must: object, seen: object) -> None:
        """Report it."""


Unclear: TypeAlias = Callable[[str], None]
"""Receives the reason why the output is unclear: two events were too close together."""


def silent() -> Playback:
    """Return a silent playback with the maximum number of channels and voices.

    It never cuts a fade short, so its levels are upper bounds.
    """
    return Playback(QUANTITIES["channel_count"].maximum, _VOICES)


class ExpectedOutputs:
    """Expected channels and layers of an amplifier, initially silent; times and intervals in
    seconds.

    - can: capabilities, empty while unknown.
    - slack [s]: tolerance of times.
    - began, cause: interval and cause of the last change.
    - is_exact: levels equal the commands within one step; may_derate: levels can be lower because
      the amplifier is warm.
    - interferes: levels show the interference of tones at the same frequency.
    - lasting: values of `valid_for` that a layer can report, of its set or a waiting one.
    """

    def __init__(
        self,
        can: Values,
        *,
        report: ReportMismatch,
        unclear: Unclear | None,
        slack: float,
        cause: str,
        began: Interval,
    ) -> None:
        self.began = began
        self.cause = cause
        self.is_exact, self.may_derate, self.interferes = True, False, False
        self._report, self._unclear, self._slack = report, unclear, slack
        self.playback = playback_of(can) if can else silent()
        """Playback with each commit in the middle of its interval."""
        self.uncertain_playback = UncertainPlayback(self.playback)
        self._half_step = can.get("level_step", 1) / 2 / _LEVEL.per_unit
        self._has_floor = True  # False after a fault, which can cut a fade short
        self._unknown = [-math.inf] * _LAYERS  # per layer, until when its output is unknown [s]
        self.lasting: dict[int, set[int]] = {}
        self._before: Sequence[float] = ()  # channel levels before the last set
        self._highest = 0.0  # upper bound of any channel's sum since the last status
        self._unlimited_since = (
            math.inf
        )  # since when a sum exceeds full level without being reported

    def forget(self) -> None:
        """Treat all outputs as unknown."""
        self._unknown = [math.inf] * _LAYERS

    # What happens

    def _faded(self, one: LayerSet, time: float) -> float:
        """Return when a layer has faded, whether it ends on its own or by a set."""
        ramp = max(_RAMP.from_wire(one.ramp), self.playback.ramp_of(one.layer))
        ends = [
            voice.ended(time, ramp).transition.end
            for voices in self.playback.all_voices
            for voice in voices
            if voice.layer == one.layer and not voice.has_ended
        ]
        return max([time + ramp, *ends])

    def play(
        self,
        layers: Sequence[LayerSet],
        token: int,
        when: Interval,
        *,
        is_exact: bool,
        is_at_once: bool = True,
    ) -> None:
        """Play a set from some time in an interval; is_exact: every command without rounding.

        is_at_once: the set can start slightly later, unlike one with a start time.
        """
        is_prompt = not (is_at_once or any(map(_is_timed, layers)))
        start, end = when[0], when[1] + (SAMPLE if is_prompt else LATE)
        if self._unclear is not None and self.uncertain_playback.is_ambiguous((start, end), layers):
            self._unclear(_AMBIGUOUS)
        shortened_by = self.uncertain_playback.shortened_by((start, end), layers)
        channels = range(self.playback.channels)
        self._before = [*map(self.playback.settled, channels)]
        for one in layers:
            number = one.layer
            lasting = self.lasting.setdefault(number, set())
            if not (one.renew or one.after):
                lasting.clear()
            if not one.renew:
                lasting.add(one.valid_for)
            half = self.uncertain_playback.half[number]
            if start - half <= self.playback.end_of(number) <= end + half:
                # It can end on its own, and then by other transitions than the set's.
                goes_on = one.renew or any(each.keep_phase for each in one.commands)
                self._unknown[number] = math.inf if goes_on else self._faded(one, end)
            elif not one.renew and not one.after:
                fade = end + _MAX_ENDING + _RAMP.from_wire(one.ramp)
                self._unknown[number] = min(self._unknown[number], fade)
            self._unknown[number] = max(self._unknown[number], shortened_by)
        self.uncertain_playback.commit(layers, token, (start, end))
        numbers = ", ".join(str(each.layer) for each in layers)
        self.began, self.cause = when, f"set {token} (layers: {numbers or 'none'})"
        self._has_floor, self.is_exact = True, self.is_exact and is_exact
        self._highest = max(self._highest, self._peak(start))

    def silence(
        self, when: Interval, ramp: float, cause: str, *, has_floor: bool = True
    ) -> Interval:
        """Fade all layers along a ramp [s] from some time in an interval; return when all are
        silent."""
        start, end = when[0], when[1] + LATE
        if self.uncertain_playback.is_ambiguous((start, end), None, ramp):
            self._unknown = [math.inf] * _LAYERS  # fades, or falls silent by its ending
            if self._unclear is not None:
                self._unclear(_AMBIGUOUS)
        self.uncertain_playback.silence((start, end), ramp)
        is_known = max(self._unknown) < start
        self._unknown = [min(until, end + ramp) for until in self._unknown]
        self.began, self.cause, self._has_floor = when, cause, has_floor
        ends, lag = self.playback.ends_by, self.uncertain_playback.lag
        first = max(ends - lag, start) if has_floor and is_known else when[0]
        return first, max(ends + lag, end if is_known else end + ramp)

    # Knowledge

    def _widened(self, when: Interval) -> Interval:
        """Return an interval widened by the clock's drift."""
        since = self.began[0]
        extra = self._slack + DRIFT * (when[1] - since)
        return when[0] - extra, when[1] + extra

    def sure(self, when: Interval) -> set[int]:
        """Return the layers whose output is known throughout an interval.

        No layer is known while the output of any layer is unknown.
        """
        start, end = self._widened(when)
        is_known = max(self._unknown) < start
        return _ALL_LAYERS - self.uncertain_playback.unsure(start, end) if is_known else set()

    def tokens_of(self, layer: int, sure: set[int]) -> set[int]:
        """Return the tokens that a layer can report; sure: layers whose output is known."""
        if layer in sure:
            return {self.playback.tokens.get(layer, 0)}
        return self.playback.next_tokens(layer)

    def waits(self, when: Interval) -> bool:
        """Return whether a set surely waits for the end of an onset throughout an interval."""
        return self.sure(when) == _ALL_LAYERS and bool(self.playback.waiting)

    def settled_at(self, now: float) -> float:
        """Return when all outputs are constant for long or silent [s], as far as is known."""
        playback, last = self.playback.copied(), now + _LASTING
        while (due := playback.next_due) < last:
            playback.advance(due)
            now = due
        ends = [voice.transition.end for voices in playback.all_voices for voice in voices]
        return max([now, *ends])

    # Statuses

    def check(self, shown: Values, when: Interval) -> None:
        """Compare a status that was true at some time in an interval, and start the next from
        there."""
        tokens, start = shown["tokens"], self._widened(when)[0]
        levels = [_LEVEL.from_wire(level) for level in shown["levels"]]
        if sure := self.sure(when):
            low = self.check_levels(levels, when, self._report)
            for layer, token in enumerate(tokens):
                possible = self.tokens_of(layer, sure)
                if token not in possible:
                    self._report(
                        "token",
                        when[1],
                        f"token of layer {layer}, {self._since(when)}",
                        must=one_of(possible),
                        seen=token,
                    )
            is_limited = has_flag(shown, "limited")
            is_beyond = low > 1 + _TOLERANCE + 2 * self._half_step
            is_excused = is_limited or not is_beyond or not self.is_exact or self.may_derate
            since = math.inf if is_excused else min(self._unlimited_since, when[1])
            self._unlimited_since = since
            must_be = start - since > _PERIOD
            if must_be > is_limited or (is_limited and self._highest < 1 + self._half_step):
                self._report("plays", when[1], "limited", must=must_be, seen=is_limited)
        for layer, until in enumerate(self._unknown):
            if until == math.inf and (layer >= len(tokens) or not tokens[layer]):
                self._unknown[layer] = when[1] + _MAX_ENDING + _RAMP.high  # it may still fade
        self._highest = self._peak(start)

    def _peak(self, time: float) -> float:
        """Return the largest future sum of a channel with endings; infinite if a set waits."""
        if self.playback.waiting:
            return math.inf
        return max(sum(voice.peak(time) for voice in voices) for voices in self.playback.all_voices)

    def check_levels(
        self, levels: Sequence[float], when: Interval, report_low: ReportMismatch | None
    ) -> float:
        """Compare channel levels; returns the highest level that a channel surely has.

        report_low: receives levels that are too low; None if low levels are allowed.
        """
        can_be_low = self.may_derate or not self.is_exact or report_low is None
        start, end = self._widened(when)
        largest = 0.0
        for channel, level in enumerate(levels[: self.playback.channels]):
            low, high = self.uncertain_playback.bounds(
                channel, start, end, is_exact=self.interferes
            )
            largest = max(largest, low)
            voices = len(self.playback.all_voices[channel])
            slack = max((_MAX_STEPS + voices) * self._half_step, _TOLERANCE)
            low, high = min(low, 1.0) * self._has_floor - slack, min(high, 1.0) + slack
            is_low = level < low
            if level > high or (is_low and not can_be_low):
                report = report_low if is_low and report_low is not None else self._report
                what = f"level of channel {channel}, {self._since(when)}"
                must = f"{max(low, 0.0):.4g} to {high:.4g}"
                report(self._rule(channel, level, when), when[1], what, must=must, seen=level)
        return largest

    def _since(self, when: Interval) -> str:
        low, high = 1e3 * (when[0] - self.began[1]), 1e3 * (when[1] - self.began[0])
        return f"{low:.1f} to {high:.1f} ms after {self.cause}"

    def _rule(self, channel: int, level: float, when: Interval) -> str:
        """Return the rule that a wrong level violates."""
        if self.cause == "the watchdog":
            return "watchdog"
        if self.playback.settles_at > self._widened(when)[0] - self.uncertain_playback.lag:
            return "ramp"
        if not self.cause.startswith("set"):
            return "silent"
        before = self._before[channel] if channel < len(self._before) else 0.0
        return "commit" if abs(level - before) < _TOLERANCE else "plays"


def _is_timed(one: LayerSet) -> bool:
    """Return whether a layer ends or starts on its own later, possibly with a delay."""
    is_shaped = any(each.onset is not None and each.onset.knots for each in one.commands)
    return bool(one.valid_for or one.after or is_shaped)


def one_of(known: Iterable[object]) -> str:
    """Format the allowed values."""
    return " or ".join(map(str, known))


CLOCK_DRIFT = DRIFT + QUANTITIES["rate"].high
"""Drift of the clock, including the largest rate."""


class ExpectedClock:
    """Expected clock of an amplifier, first unknown; report: receives violations; slack [s]."""

    def __init__(self, report: ReportMismatch, slack: float) -> None:
        self._report, self._slack = report, slack
        self._read: tuple[int, Interval] | None = None  # last reading and its interval
        self._marked: Interval | None = None
        self._is_unclear = False

    @property
    def present(self) -> int:
        """Return the high word read last, which is not in the future."""
        return 0 if self._read is None else high_word(self._read[0])

    @property
    def is_marked(self) -> bool:
        """Return whether the next status shows the clock of a Mark."""
        return self._marked is not None

    def mark(self, when: Interval) -> None:
        """Record a Mark that arrives in an interval."""
        self._marked = when

    def shifted(self) -> None:
        """Record that the clock can continue from another value."""
        self._read = None

    def unheard(self) -> None:
        """Record that the next status can show another clock than the last known request's.

        Either the current clock, if an earlier status showed the Mark, or a repeated Mark's clock.
        """
        self._is_unclear = True

    def check(self, shown: int, when: Interval) -> None:
        """Record the clock in a status, or compare it if it is the clock of a Mark."""
        marked, self._marked = self._marked, None
        is_unclear, self._is_unclear = self._is_unclear, False
        if is_unclear:
            return
        if marked is None:
            self._read = shown, when
        elif self._read is not None:
            clock, read = self._read
            slack = self._slack + CLOCK_DRIFT * (marked[1] - read[0])
            low, high = marked[0] - read[1] - slack, marked[1] - read[0] + slack
            passed = ahead(shown, clock)
            if not low <= passed <= high:
                what, must = (
                    "time from the last clock reading to a Mark's reading",
                    f"{low} to {high} s",
                )
                self._report("clock", when[1], what, must=must, seen=passed)

    def moment(self, at: int, when: Interval) -> Interval | None:
        """Return when a set starts whose commit names a high word and arrives in an interval.

        None if it surely starts immediately.
        """
        if self._read is None:
            return when[0], when[1] + MAX_AHEAD
        clock, read = self._read
        left = ahead(at * HIGH_STEPS, clock)
        drift = CLOCK_DRIFT * max(when[1] - read[0], left)
        early, late = read[0] + left - drift, read[1] + left + drift
        if early > when[1] and late <= when[0] + MAX_AHEAD:
            return early, late
        if late <= when[0] or early > when[1] + MAX_AHEAD:
            return None
        return when[0], max(when[1], late)
