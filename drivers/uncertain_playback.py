"""What channels may play by sets whose commits are known only as intervals.

The playback has each commit in the middle of its interval. Beside every transition stands by how
much sooner or later it may have begun, and a radius by which its first amplitude may differ. Times
[s] are of any one clock; intervals are two times.
"""

import cmath
import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple, TypeAlias

from drivers.playback import Playback
from drivers.protocol.sets import LayerSet
from drivers.protocol.table import QUANTITIES
from drivers.voices import Transition, Voice

Interval: TypeAlias = tuple[float, float]
_LAYERS = QUANTITIES["layer_count"].maximum
_PER_RAMP, _PER_VALID_FOR = QUANTITIES["ramp"].per_unit, QUANTITIES["valid_for"].per_unit


class _Mark(NamedTuple):
    """Half the time within which a transition began [s], and the radius of its first amplitude."""

    way: Transition
    half: float = 0.0
    radius: float = 0.0


class UncertainPlayback:
    """Bounds of what channels play; playback: with every commit in the middle of its interval.

    half: by how much what a layer plays may end or start sooner or later by itself.
    """

    def __init__(self, playback: Playback) -> None:
        self.playback = playback
        self.half = [0.0] * _LAYERS
        self._marks: dict[int, _Mark] = {}
        # Channels of voices that are gone, and until when [s] they may still play.
        self._ghosts: list[tuple[int, _Mark, float]] = []
        self._origins: dict[float, float] = {}  # half the interval of the origins of phases

    def copied(self) -> "UncertainPlayback":
        """Return it as it is, to look ahead while the original stays."""
        copied = UncertainPlayback(self.playback.copied())
        copied.half, copied._ghosts = [*self.half], self._ghosts
        copied._marks, copied._origins = self._marks, {**self._origins}
        return copied

    @property
    def lag(self) -> float:
        """Longest time by which a transition under way may be earlier or later [s]."""
        return max(*self.half, *(mark.half for mark in self._marks.values()), 0.0)

    def is_ambiguous(
        self, when: Interval, layers: Sequence[LayerSet] | None = None, ramp: float = 0.0
    ) -> bool:
        """Whether something else may happen by itself just as what is to happen.

        layers: of a set; None: all fall silent along a ramp [s].
        """
        changed = dict.fromkeys(range(_LAYERS), False)
        sooner = dict.fromkeys(range(_LAYERS), ramp)  # of what falls silent: its end, from now on
        if layers is not None:
            changed = {one.layer: one.after for one in layers}
            sooner = {one.layer: self._ends_after(one) for one in layers}
        # Of all layers: what is due is taken to have happened before what is to happen, or after.
        ends = [(due, self.half[layer]) for due, layer in self.playback.dues]
        ends += [(self.playback.end_of(layer), self.half[layer]) for layer in changed]
        by_then = self.copied()
        by_then._pass_until(when[0])
        waiting = {one.layer for one in by_then.playback.waiting}
        for voice in (voice for voices in by_then.playback.all_voices for voice in voices):
            way, half = voice.transition, by_then._mark_of(voice.transition).half
            is_followed = voice.layer in waiting or changed.get(voice.layer, False)
            is_due = not way.last or (is_followed and bool(way.knots))
            left = sooner.get(voice.layer, 0.0)
            if left and not way.last and way.step and (layers is None or not voice.has_ended):
                ends.append((way.end - left, half))  # it goes on, or ends sooner
            if not voice.has_ended and voice.layer in changed and is_due:
                ends.append((way.end, half))
        return any(when[0] - half <= end <= when[1] + half for end, half in ends)

    def _ends_after(self, one: LayerSet) -> float:
        """Return how long after a set a layer is silent that falls silent by it [s]."""
        if not one.renew:
            return one.ramp / _PER_RAMP
        return self.playback.ramp_of(one.layer) + one.valid_for / _PER_VALID_FOR

    def commit(self, layers: Sequence[LayerSet], token: int, when: Interval) -> None:
        """Play a set from some time between two on."""
        half = (when[1] - when[0]) / 2
        self.advance(when[0])
        self._pass_until(when[0] + half)
        for one in layers:
            self.half[one.layer] = max(half, self.half[one.layer] if one.after else 0.0)
        before = [*self.playback.all_voices]
        self.playback.commit(layers, token, when[0] + half)
        self._mark(before, when)

    def silence(self, when: Interval, ramp: float) -> None:
        """Fade all layers along a ramp [s], from some time between two on."""
        middle = (when[0] + when[1]) / 2
        self.advance(when[0])
        self._pass_until(middle)
        before = [*self.playback.all_voices]
        self.playback.silence(middle, ramp)
        self._mark(before, when)

    def advance(self, time: float) -> None:
        """End layers and start what waits, where that must have happened by a time."""
        certain = time - self.lag
        self._pass_until(certain)
        self.playback.advance(certain)

    def _pass_until(self, time: float) -> None:
        """Carry out what is due by a time."""
        while (due := self.playback.next_due) <= time:
            half, before = max(self.half), [*self.playback.all_voices]
            self.playback.advance(due)
            self._mark(before, (due - half, due + half))

    def possible(self, start: float, end: float) -> Iterator["UncertainPlayback"]:
        """Yield what may play between two times: before and after what may be due, in any order.

        What is due of several layers at one time happens at once. The last has all of it behind it.
        """
        self.advance(start)
        states = {frozenset[float](): self}
        while states:
            yield from states.values()
            after: dict[frozenset[float], UncertainPlayback] = {}
            for passed, state in states.items():
                for due in state._first_dues(end + self.lag):
                    if passed | {due} not in after:
                        after[passed | {due}] = state._after(due)
            states = after

    def _first_dues(self, until: float) -> set[float]:
        """Return the times by another at which what is due may come before all other."""
        dues = self.playback.dues
        first = min((due + self.half[layer] for due, layer in dues), default=until)
        return {due for due, layer in dues if due <= until and due - self.half[layer] <= first}

    def _after(self, due: float) -> "UncertainPlayback":
        """Return what plays once that has happened which is due at a time, and nothing else."""
        after, half = self.copied(), max(self.half)
        for each in self.playback.dues:
            if each[0] == due:
                after.playback.carry_out(*each)
        after._mark(self.playback.all_voices, (due - half, due + half))
        return after

    def _mark(self, before: Sequence[Sequence[Voice]], when: Interval) -> None:
        """Note the radius of every transition that is new."""
        half, marks = (when[1] - when[0]) / 2, dict[int, _Mark]()
        ghosts = [each for each in self._ghosts if each[2] > when[0]]
        for channel, were in enumerate(before):
            left = {(each.layer, each.frequency, each.origin): each.transition for each in were}
            known = dict(left)
            for voice in self.playback.voices_of(channel):
                name, way = (voice.layer, voice.frequency, voice.origin), voice.transition
                left.pop(name, None)
                self._origins.setdefault(voice.origin, half)
                radius = self.radius(known[name], *when) if name in known else 0.0
                marks[id(way)] = self._marks.get(id(way)) or _Mark(way, half, radius)
            for mark in map(self._mark_of, left.values()):
                is_cut = mark.way.last or mark.way.end > (when[0] + when[1]) / 2
                until = when[1] if is_cut else mark.way.end + mark.half
                if until > when[0]:
                    ghosts.append((channel, mark, until))
        self._marks, self._ghosts = marks, ghosts
        origins = {voice.origin for voices in self.playback.all_voices for voice in voices}
        self._origins = {each: self._origins[each] for each in origins}

    def _mark_of(self, way: Transition) -> _Mark:
        return self._marks.get(id(way)) or _Mark(way)

    def radius(self, way: Transition, start: float, end: float) -> float:
        """Return by how much an amplitude may differ from that in the middle of an interval.

        Its transition has begun by then.
        """
        _, half, radius = self._mark_of(way)
        center = _reached(way, (start + end) / 2)
        since, until = max(start - half, way.start), max(end + half, way.start)
        reach = max(abs(each - center) for each in way.points(since, until))
        if not radius:
            return reach
        # The first amplitude counts the less the farther its transition has led.
        left = Transition(way.start, way.step, radius, 0, way.end, (0j,) * len(way.knots))
        return reach + abs(left.at(since))

    def bounds(self, channel: int, start: float, end: float, *, is_exact: bool = False) -> Interval:
        """Return the lowest and the largest level of a channel between two times.

        Nothing may be due between them; see `possible`. is_exact: tones of one frequency interfere;
        else they may add up as if they did not.
        """
        lowest = highest = 0.0
        groups: dict[float, dict[float, list[Voice]]] = {}
        for voice in self.playback.voices_of(channel):
            groups.setdefault(voice.frequency, {}).setdefault(voice.origin, []).append(voice)
        for frequency, by_origin in groups.items():
            low, high = self._sum(frequency, by_origin, start, end, is_exact=is_exact)
            lowest += low
            highest += high
        for at, mark, until in self._ghosts:
            if at == channel and until > start:
                ghost = abs(_reached(mark.way, start - mark.half)) + mark.radius
                lowest, highest = lowest - ghost, highest + ghost
        return max(lowest, 0.0), highest

    def _sum(
        self,
        frequency: float,
        by_origin: dict[float, list[Voice]],
        start: float,
        end: float,
        *,
        is_exact: bool,
    ) -> Interval:
        """Return the lowest and largest sum of tones of one frequency, by their origins."""
        highest, total, uncertain = 0.0, 0j, 0.0
        discs: list[tuple[float, float]] = []
        for origin, voices in by_origin.items():
            center, radius = 0j, 0.0
            for voice in voices:
                amplitude = _reached(voice.transition, (start + end) / 2)
                reach = self.radius(voice.transition, start, end)
                highest += abs(amplitude) + reach
                center += amplitude
                radius += reach
            discs.append((abs(center), radius))
            total += center * cmath.rect(1, -2 * math.pi * frequency * origin)
            turned = min(math.pi * frequency * self._origins.get(origin, 0.0), math.pi / 2)
            uncertain += radius + 2 * abs(center) * math.sin(turned) * (len(by_origin) > 1)
        if is_exact:
            return max(abs(total) - uncertain, 0.0), min(abs(total) + uncertain, highest)
        # Tones of one frequency that began at different times may cancel.
        highs = sum(center + radius for center, radius in discs)
        return max(0.0, *(2 * center - highs for center, _ in discs)), highest


def _reached(way: Transition, time: float) -> complex:
    """Return the amplitude at a time, or at the start of a transition that has begun sooner."""
    return way.at(max(time, way.start))
