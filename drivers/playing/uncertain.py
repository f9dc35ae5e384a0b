"""What channels may play by sets whose commits are known only as intervals.

The playback has each commit in the middle of its interval. Every transition has by how much sooner
or later it may have begun, and a radius by which its first amplitude may differ. Times [s] are of
any one clock; intervals are two times.
"""

import math
from collections.abc import Sequence
from itertools import chain
from typing import TypeAlias

from drivers.playing.playback import LAYERS_MAX, Playback
from drivers.playing.voices import Transition, Voice
from drivers.protocol.definition import QUANTITIES
from drivers.protocol.sets import LayerSet

Interval: TypeAlias = tuple[float, float]
_PER_LEVEL = QUANTITIES["level"].per_unit
_PER_RAMP, _PER_VALID_FOR = QUANTITIES["ramp"].per_unit, QUANTITIES["valid_for"].per_unit


class UncertainPlayback:
    """Bounds of what channels play; playback: with every commit in the middle of its interval.

    half: by how much what a layer plays may end or start sooner or later by itself.
    """

    def __init__(self, playback: Playback) -> None:
        self.playback = playback
        self.half = [0.0] * LAYERS_MAX
        # Channels of transitions that are gone, and until when [s] they may still play.
        self._ghosts: list[tuple[int, Transition, float]] = []

    @property
    def lag(self) -> float:
        """Longest time by which a transition under way may be earlier or later [s]."""
        voices = chain.from_iterable(self.playback.all_voices)
        return max(*self.half, *(voice.transition.half for voice in voices), 0.0)

    def is_ambiguous(
        self, when: Interval, layers: Sequence[LayerSet] | None = None, ramp: float = 0.0
    ) -> bool:
        """Whether something else may happen by itself just as what is to happen.

        layers: of a set; None: all fall silent along a ramp [s].
        """
        if self.shortened_by(when, layers, ramp) > -math.inf:
            return True
        changed = dict.fromkeys(range(LAYERS_MAX), False)
        if layers is not None:
            changed = {one.layer: one.after for one in layers}
        # Of all layers: what is due is taken to have happened before what is to happen, or after.
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
        """Return by when [s] what leads to silence has ended that a ramp may shorten, or not.

        As its own end and that of the ramp are too close; minus infinity: there is none. layers,
        ramp: see `is_ambiguous`.
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
        """Return what plays with all carried out that is due by a time."""
        by_then = self.playback.copied()
        while (due := by_then.next_due) <= time:
            by_then.advance(due)
        return by_then

    def _half_of(self, voice: Voice) -> float:
        """Return by how much what a voice plays may end sooner or later."""
        return max(voice.transition.half, self.half[voice.layer])

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
            known = self.half[one.layer]
            onset_by = self.playback.onsets_end(one.layer, -math.inf) + known
            # What waits, or will, starts as the onset ends, whenever that is renewed.
            is_kept = one.after or (one.renew and onset_by > when[0])
            self.half[one.layer] = max(half, known if is_kept else 0.0)
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

    def unsure(self, start: float, end: float) -> set[int]:
        """Return the layers that may end or start by themselves about between two times."""
        self.advance(start)
        return self.playback.unsure(end, self.half)

    def _mark(self, before: Sequence[Sequence[Voice]], when: Interval) -> None:
        """Note by how much every transition that is new may differ."""
        half = (when[1] - when[0]) / 2
        ghosts = [each for each in self._ghosts if each[2] > when[0]]
        for channel, were in enumerate(before):
            left = {(each.layer, each.frequency, each.began): each.transition for each in were}
            known = {id(each.transition) for each in were}
            for voice in self.playback.all_voices[channel]:
                way = voice.transition
                earlier = left.pop((voice.layer, voice.frequency, voice.began), None)
                if id(way) not in known:
                    way.half = half
                    way.radius = 0.0 if earlier is None else radius_of(earlier, *when)
            for way in left.values():
                is_cut = way.last or way.end > (when[0] + when[1]) / 2
                until = when[1] if is_cut else way.end + way.half
                if until > when[0]:
                    ghosts.append((channel, way, until))
        self._ghosts = ghosts

    def bounds(self, channel: int, start: float, end: float, *, is_exact: bool = False) -> Interval:
        """Return the lowest and the largest level of a channel between two times.

        What layers play that may end or start then may be anything up to its largest. is_exact:
        tones of one frequency interfere; else they may add up as if they did not.
        """
        unsure = self.unsure(start, end)
        lowest = highest = extra = 0.0
        began = start - 3 * self.lag  # or later; by the clocks of layer, set and transition
        for one in self.playback.waiting:
            tones = [each for each in one.commands if each.channel == channel]
            for tone in tones if one.layer in unsure else ():
                extra += tone.peak / _PER_LEVEL
        groups: dict[float, list[Transition]] = {}
        for voice in self.playback.all_voices[channel]:
            if voice.layer in unsure and not voice.has_ended:
                extra += voice.peak(began) + voice.transition.radius
                continue
            groups.setdefault(voice.frequency, []).append(voice.transition)
        for ways in groups.values():
            amplitudes = [_reached(way, (start + end) / 2) for way in ways]
            radius = sum(radius_of(way, start, end) for way in ways)
            level, added = abs(sum(amplitudes)), sum(map(abs, amplitudes))
            lowest += max(level - radius, 0.0)
            highest += (level if is_exact else added) + radius
        for at, way, until in self._ghosts:
            if at == channel and until > start:
                extra += abs(_reached(way, start - way.half)) + way.radius
        return max(lowest - extra, 0.0), highest + extra


def radius_of(way: Transition, start: float, end: float) -> float:
    """Return by how much an amplitude may differ from that in the middle of an interval.

    Its transition has begun by then.
    """
    center = _reached(way, (start + end) / 2)
    since, until = max(start - way.half, way.start), max(end + way.half, way.start)
    reach = max(abs(each - center) for each in way.points(since, until))
    if not way.radius:
        return reach
    # The first amplitude counts the less the farther its transition has led.
    left = Transition(way.start, way.step, way.radius, 0, way.end, (0j,) * len(way.knots))
    return reach + abs(left.at(since))


def _reached(way: Transition, time: float) -> complex:
    """Return the amplitude at a time, or at the start of a transition that has begun sooner."""
    return way.at(max(time, way.start))
