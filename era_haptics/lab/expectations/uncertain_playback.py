"""Bounds of an amplifier's outputs after sets whose start is known only as an interval.

A set starts at some time between its commit and the reply, or slightly later. The playback places
each commit in the middle of its interval. Every transition has a `Tolerance`: a half-width of its
start time, and a radius around its first amplitude. Times [s] refer to any clock.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import chain
from typing import NamedTuple

from drivers.playing import LAYERS_MAX, Playback
from drivers.protocol.definition import QUANTITIES
from drivers.protocol.sets import LayerSet
from drivers.voices import Voice, VoiceTransition
from era_haptics.lab.expectations.tolerances import Interval

_PER_LEVEL = QUANTITIES["level"].per_unit
_PER_RAMP = QUANTITIES["ramp"].per_unit
_PER_VALID_FOR = QUANTITIES["valid_for"].per_unit


class Tolerance(NamedTuple):
    """How uncertain a transition is."""

    transition: VoiceTransition
    half_width: float = 0.0
    """Half-width of its start time [s]."""
    radius: float = 0.0
    """How far its first amplitude can differ."""

    def radius_within(self, start: float, end: float) -> float:
        """Return how far the amplitude can differ from the one in the middle of an interval.

        The transition has begun by the middle.
        """
        transition = self.transition
        center = _reached(transition, (start + end) / 2)
        since = max(start - self.half_width, transition.start)
        until = max(end + self.half_width, transition.start)
        radius = max(abs(point - center) for point in transition.points(since, until))
        if not self.radius:
            return radius
        # The effect of the first amplitude decays along the transition.
        knots = (0j,) * len(transition.knots)
        decay = replace(transition, first=self.radius, last=0, knots=knots)
        return radius + abs(decay.at(since))


class _ReplacedTransition(NamedTuple):
    """Transition of a channel that was replaced, and until when [s] it can still play."""

    channel: int
    tolerance: Tolerance
    until: float


class UncertainPlayback:
    """Bounds of channel outputs; playback: places each commit in the middle of its interval.

    half_widths: of the times at which layers end or start on their own.
    """

    def __init__(self, playback: Playback) -> None:
        self.playback = playback
        self.half_widths = [0.0] * LAYERS_MAX
        self._replaced: list[_ReplacedTransition] = []
        # Of transitions whose start is uncertain, by identity.
        self._tolerances: dict[int, Tolerance] = {}

    def _tolerance_of(self, transition: VoiceTransition) -> Tolerance:
        """Return the tolerance of a transition."""
        return self._tolerances.get(id(transition)) or Tolerance(transition)

    @property
    def lag(self) -> float:
        """Largest half-width of a running transition's start time [s]."""
        voices = chain.from_iterable(self.playback.all_voices)
        half_widths = [self._tolerance_of(voice.transition).half_width for voice in voices]
        return max(*self.half_widths, *half_widths, 0.0)

    # Ambiguous requests

    def is_ambiguous(
        self, when: Interval, layers: Sequence[LayerSet] | None = None, ramp: float = 0.0
    ) -> bool:
        """Return whether a spontaneous change can coincide with a requested one.

        layers: of a set; None: all layers fade along a ramp [s].
        """
        if self.shortened_by(when, layers, ramp) > -math.inf:
            return True
        for time, half_width in self._spontaneous_changes(when.earliest, layers):
            if when.earliest - half_width <= time <= when.latest + half_width:
                return True
        return False

    def _spontaneous_changes(
        self, start: float, layers: Sequence[LayerSet] | None
    ) -> Iterator[tuple[float, float]]:
        """Yield times and half-widths of changes that can precede or follow a request.

        start: earliest time of the request [s]; layers: see `is_ambiguous`.
        """
        has_after = dict.fromkeys(range(LAYERS_MAX), False)
        if layers is not None:
            has_after = {layer_set.layer: layer_set.after for layer_set in layers}
        for due, layer in self.playback.dues:
            yield due, self.half_widths[layer]
        for layer in has_after:
            yield self.playback.end_of(layer), self.half_widths[layer]
        advanced = self._advanced_copy(start)
        waiting_layers = {layer_set.layer for layer_set in advanced.waiting}
        for voice in chain.from_iterable(advanced.all_voices):
            if voice.has_ended or voice.layer not in has_after:
                continue
            transition = voice.transition
            is_followed = voice.layer in waiting_layers or has_after[voice.layer]
            if not transition.last or (is_followed and transition.knots):
                yield transition.end, self._half_width_of(voice)

    def shortened_by(
        self, when: Interval, layers: Sequence[LayerSet] | None, ramp: float = 0.0
    ) -> float:
        """Return until when [s] it is unclear whether a ramp shortens an ending.

        This happens if the ending and the ramp end almost simultaneously; minus infinity if none
        do. layers, ramp: see `is_ambiguous`.
        """
        fades = dict.fromkeys(range(LAYERS_MAX), ramp)
        if layers is not None:
            fades = {layer_set.layer: self._fade_of(layer_set) for layer_set in layers}
        latest = -math.inf
        for voice in chain.from_iterable(self._advanced_copy(when.earliest).all_voices):
            transition = voice.transition
            fade = fades.get(voice.layer, 0.0)
            keeps_ending = layers is not None and voice.has_ended
            if not fade or transition.last or not transition.step or keeps_ending:
                continue
            half_width = self._half_width_of(voice)
            fade_start = transition.end - fade  # of a fade that ends simultaneously
            if when.earliest - half_width <= fade_start <= when.latest + half_width:
                latest = max(latest, transition.end + half_width, when.latest + fade)
        return latest

    def _advanced_copy(self, time: float) -> Playback:
        """Return a copy of the playback in which everything due by a time has been carried out."""
        playback = self.playback.copied()
        while (due := playback.next_due) <= time:
            playback.advance(due)
        return playback

    def _half_width_of(self, voice: Voice) -> float:
        """Return the half-width of the time at which a voice ends."""
        half_width = self._tolerance_of(voice.transition).half_width
        return max(half_width, self.half_widths[voice.layer])

    def _fade_of(self, layer_set: LayerSet) -> float:
        """Return how long a layer takes to fall silent after a set that ends it [s]."""
        if not layer_set.renew:
            return layer_set.ramp / _PER_RAMP
        ramp = self.playback.ramp_of(layer_set.layer)
        return ramp + layer_set.valid_for / _PER_VALID_FOR

    # Changes

    def commit(self, layers: Sequence[LayerSet], token: int, when: Interval) -> None:
        """Play a set from some time in an interval."""
        middle = when.earliest + when.half_width
        self.advance(when.earliest)
        self._pass_until(middle)
        for layer_set in layers:
            half_width = max(when.half_width, self._kept_half_width(layer_set, when))
            self.half_widths[layer_set.layer] = half_width
        former_voices = [*self.playback.all_voices]
        self.playback.commit(layers, token, middle)
        self._note_transitions(former_voices, when)

    def _kept_half_width(self, layer_set: LayerSet, when: Interval) -> float:
        """Return the half-width of a layer that remains after a set; 0 if a new one replaces it.

        A waiting set starts when the onset ends, whenever the onset is renewed.
        """
        half_width = self.half_widths[layer_set.layer]
        onset_end = self.playback.onsets_end(layer_set.layer, -math.inf) + half_width
        is_kept = layer_set.after or (layer_set.renew and onset_end > when.earliest)
        return half_width if is_kept else 0.0

    def silence(self, when: Interval, ramp: float) -> None:
        """Fade all layers along a ramp [s], from some time in an interval."""
        middle = (when.earliest + when.latest) / 2
        self.advance(when.earliest)
        self._pass_until(middle)
        former_voices = [*self.playback.all_voices]
        self.playback.silence(middle, ramp)
        self._note_transitions(former_voices, when)

    def advance(self, time: float) -> None:
        """End layers and start waiting sets that must have done so by a time."""
        certain = time - self.lag
        self._pass_until(certain)
        self.playback.advance(certain)

    def _pass_until(self, time: float) -> None:
        """Carry out everything due by a time."""
        while (due := self.playback.next_due) <= time:
            half_width = max(self.half_widths)
            former_voices = [*self.playback.all_voices]
            self.playback.advance(due)
            self._note_transitions(former_voices, Interval(due - half_width, due + half_width))

    def _note_transitions(self, former_voices: Sequence[Sequence[Voice]], when: Interval) -> None:
        """Note the tolerances of new transitions, and keep the transitions that they replace."""
        self._replaced = [replaced for replaced in self._replaced if replaced.until > when.earliest]
        tolerances = []
        for channel, voices in enumerate(former_voices):
            former = {_key_of(voice): self._tolerance_of(voice.transition) for voice in voices}
            unchanged = {id(voice.transition) for voice in voices}
            for voice in self.playback.all_voices[channel]:
                transition = voice.transition
                former_tolerance = former.pop(_key_of(voice), None)
                if id(transition) in unchanged:
                    tolerances.append(self._tolerance_of(transition))
                    continue
                radius = 0.0
                if former_tolerance is not None:
                    radius = former_tolerance.radius_within(*when)
                tolerances.append(Tolerance(transition, when.half_width, radius))
            for tolerance in former.values():
                self._keep(channel, tolerance, when)
        self._tolerances = {id(tolerance.transition): tolerance for tolerance in tolerances}

    def _keep(self, channel: int, tolerance: Tolerance, when: Interval) -> None:
        """Keep a transition that was replaced in an interval, if it can still play."""
        transition = tolerance.transition
        is_cut = transition.last or transition.end > (when.earliest + when.latest) / 2
        until = when.latest if is_cut else transition.end + tolerance.half_width
        if until > when.earliest:
            self._replaced.append(_ReplacedTransition(channel, tolerance, until))

    # Bounds

    def unsure(self, start: float, end: float) -> set[int]:
        """Return the layers that can end or start on their own in an interval."""
        self.advance(start)
        unsure_layers = set()
        for due, layer in self.playback.dues:
            if due - self.half_widths[layer] <= end:
                unsure_layers.add(layer)
        for voice in chain.from_iterable(self.playback.all_voices):
            tolerance = self._tolerance_of(voice.transition)
            is_falling = not (voice.transition.last or voice.has_ended)
            if is_falling and voice.transition.end - tolerance.half_width <= end:
                unsure_layers.add(voice.layer)
        return unsure_layers

    def bounds(
        self, channel: int, start: float, end: float, *, is_exact: bool = False
    ) -> tuple[float, float]:
        """Return the lowest and the highest level of a channel during an interval.

        A layer that can end or start in the interval counts from zero to its peak. is_exact: tones
        at the same frequency interfere; otherwise their amplitudes can add up.
        """
        unsure_layers = self.unsure(start, end)
        possible = self._possible_level(channel, start, unsure_layers)
        lowest = highest = 0.0
        middle = (start + end) / 2
        for tolerances in self._tolerances_by_frequency(channel, unsure_layers):
            amplitudes = [_reached(tolerance.transition, middle) for tolerance in tolerances]
            radius = sum(tolerance.radius_within(start, end) for tolerance in tolerances)
            level = abs(sum(amplitudes))
            max_level = level if is_exact else sum(map(abs, amplitudes))
            lowest += max(level - radius, 0.0)
            highest += max_level + radius
        return max(lowest - possible, 0.0), highest + possible

    def _possible_level(self, channel: int, start: float, unsure_layers: set[int]) -> float:
        """Return the sum of all levels of a channel that may or may not play from a time on."""
        level = 0.0
        for layer_set in self.playback.waiting:
            for tone in layer_set.commands:
                if tone.channel == channel and layer_set.layer in unsure_layers:
                    level += tone.peak / _PER_LEVEL
        # Or later; layer, set and transition have separate clocks.
        began = start - 3 * self.lag
        for voice in self.playback.all_voices[channel]:
            if voice.layer in unsure_layers and not voice.has_ended:
                level += voice.peak(began) + self._tolerance_of(voice.transition).radius
        for replaced in self._replaced:
            if replaced.channel == channel and replaced.until > start:
                transition, half_width, radius = replaced.tolerance
                level += abs(_reached(transition, start - half_width)) + radius
        return level

    def _tolerances_by_frequency(
        self, channel: int, unsure_layers: set[int]
    ) -> list[list[Tolerance]]:
        """Return the transitions that surely play on a channel, grouped by frequency."""
        groups: dict[float, list[Tolerance]] = {}
        for voice in self.playback.all_voices[channel]:
            if voice.has_ended or voice.layer not in unsure_layers:
                tolerance = self._tolerance_of(voice.transition)
                groups.setdefault(voice.frequency, []).append(tolerance)
        return [*groups.values()]


def _key_of(voice: Voice) -> tuple[int, float, float]:
    """Return a key that a voice keeps while its transitions change."""
    return voice.layer, voice.frequency, voice.began


def _reached(transition: VoiceTransition, time: float) -> complex:
    """Return the amplitude at a time, or at the start of a transition that begins later."""
    return transition.at(max(time, transition.start))
