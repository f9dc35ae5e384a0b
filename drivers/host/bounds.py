"""The worst case of a set relative to the limits of an amplifier.

`Bounds` gives the largest level, power and rise over all layers. A set starts at an unknown moment
within the next tenth of a second. `drivers.playing` computes the voices after a commit in the
middle of this time span, with half the span as uncertainty:

    magnitude
        |   old voice: may fade later
        | - - - - - - - - - -.
        |   .                  `.   new voice: rises to its last
        |     `.               .-`------------------------
        |       `.          .-`   `.
        |         `.     .-`        `.
        |___________`_.-`_____________`.__________________ time
               since     middle     until
                 |<-- it may start -->|

Every amplitude moves on straight lines in the complex plane, between the points of its transition:

      Im|    first
        |     *
        |      `.         The magnitude is the distance from 0, a convex function on each line:
        |        `*knot   it is largest at one of the ends.
        |         |
        |_________*last__ Re

Sums of magnitudes are convex too while all voices move at the same pace, so only the points are
compared. In an interval in which voices move at different paces, each one counts with the larger of
its two ends.

`PeakSums` is a coarse bound, five times as fast, which suffices for most sets without a limit of
the slew: it adds up the peaks of all voices, as if they occurred simultaneously.
"""

import math
from collections.abc import Sequence
from itertools import pairwise, product, zip_longest
from operator import add
from typing import NamedTuple

from drivers.playing import Playback
from drivers.protocol.definition import QUANTITIES
from drivers.protocol.sets import Command, LayerSet
from drivers.voices import (
    SAME,
    Slope,
    Voice,
    VoiceTransition,
    along,
    peak_of,
    steepest,
    voices_after,
)

_PER_RAMP = QUANTITIES["ramp"].per_unit
_PER_VALID_FOR = QUANTITIES["valid_for"].per_unit
_LEVEL = QUANTITIES["level"]
_FREQUENCY = QUANTITIES["frequency"]
_SILENCE: Sequence[complex] = (0j,)
_NO_SETS: Sequence[LayerSet] = ()


class _PossibleVoice(NamedTuple):
    """A voice as it may play after the sets."""

    voice: Voice
    """The voice after all sets."""
    starts: Sequence[complex]
    """Possible amplitudes at the start of its transition."""
    layer_sets: Sequence[LayerSet] = ()
    """Sets of its layer, which may end it; empty once the voice has ended."""
    is_changed: bool = True
    """Whether a set gives it a new transition."""
    is_waiting: bool = False
    """Whether that set waits for the end of an onset."""
    continues: bool = False
    """Whether it then continues the voice of its frequency in its layer."""


class Bounds:
    """The loudest and fastest that channels can play if layers start between two times [s]."""

    def __init__(
        self, playback: Playback, layers: Sequence[LayerSet], since: float, until: float
    ) -> None:
        self._playback = playback
        self._since = since
        self._middle = (since + until) / 2
        self._half = (until - since) / 2
        self._layer_sets: dict[int, list[LayerSet]] = {}
        self._possible: list[list[_PossibleVoice]] = [[] for _ in playback.all_voices]
        started = [layer_set for layer_set in layers if not layer_set.renew]
        all_sets = (*started, *playback.waiting)
        for layer_set in all_sets:
            self._layer_sets.setdefault(layer_set.layer, []).append(layer_set)
        layers_set = {layer_set.layer for layer_set in started}
        ending = {layer for layer in layers_set if playback.end_of(layer) <= until}
        voices_by_channel = [*playback.all_voices]
        for layer_set in all_sets:
            is_ending = layer_set.layer in ending
            if layer_set.after:
                self._add_waiting(layer_set, is_ending=is_ending)
            else:
                voices_by_channel = self._after_set(
                    voices_by_channel, layer_set, is_ending=is_ending
                )
        for channel, voices in enumerate(voices_by_channel):
            old_voices = playback.all_voices[channel]
            for old_voice, voice in zip_longest(old_voices, voices):
                self._possible[channel].append(self._possible_voice(old_voice, voice))

    def _after_set(
        self, voices_by_channel: list[tuple[Voice, ...]], layer_set: LayerSet, *, is_ending: bool
    ) -> list[tuple[Voice, ...]]:
        """Return the voices of all channels after a set.

        is_ending: whether its layer may have begun to end when the set starts. Then the ending
        voices and the new ones count independently.
        """
        if not is_ending:
            ramp = layer_set.ramp / _PER_RAMP
            commands = _by_channel(layer_set)
            return voices_after(
                voices_by_channel, layer_set.layer, commands, self._middle, ramp, self._half
            )
        voices_after_set = []
        new_voices = self._voices_alone(layer_set)
        for voices, new in zip(voices_by_channel, new_voices, strict=True):
            voices_after_set.append((*voices, *new))
        return voices_after_set

    def _voices_alone(self, layer_set: LayerSet) -> list[tuple[Voice, ...]]:
        """Return the voices of all channels if only this set plays, from the middle on."""
        silent: list[tuple[Voice, ...]] = [()] * len(self._possible)
        ramp = layer_set.ramp / _PER_RAMP
        commands = _by_channel(layer_set)
        return voices_after(silent, layer_set.layer, commands, self._middle, ramp, 0.0)

    def _add_waiting(self, layer_set: LayerSet, *, is_ending: bool) -> None:
        """Add the voices of a set that waits; is_ending: see `_after_set`."""
        commands = _by_channel(layer_set)
        for channel, voices in enumerate(self._voices_alone(layer_set)):
            for voice in voices:
                continues = commands[channel].keep_phase and not is_ending
                starts = self._waiting_starts(channel, voice)
                possible = _PossibleVoice(voice, starts, is_waiting=True, continues=continues)
                self._possible[channel].append(possible)

    def _waiting_starts(self, channel: int, voice: Voice) -> Sequence[complex]:
        """Return where a waiting voice may start: silent, or from a voice that it continues."""
        starts = [0j]
        for old_voice in self._playback.all_voices[channel]:
            if (old_voice.layer, old_voice.frequency) == (voice.layer, voice.frequency):
                starts += old_voice.transition.points(self._since)
        return starts

    def _possible_voice(self, old_voice: Voice | None, voice: Voice) -> _PossibleVoice:
        """Return a voice after all sets; old_voice: before the sets, None for a new voice."""
        layer_sets = self._layer_sets.get(voice.layer, _NO_SETS)
        if old_voice is None:
            return _PossibleVoice(voice, _SILENCE, layer_sets)
        old_transition = old_voice.transition
        starts = old_transition.points(self._since)
        is_changed = old_transition is not voice.transition
        # A voice that is falling silent continues to do so if that ends before a fade would.
        latest_end = voice.transition.end + self._half + SAME
        is_fading = is_changed and voice.has_ended and not voice.transition.knots
        if is_fading and not old_transition.last and old_transition.end <= latest_end:
            voice = old_voice
            is_changed = False
        if old_voice.has_ended:
            layer_sets = _NO_SETS
        return _PossibleVoice(voice, starts, layer_sets, is_changed)

    def worst(self) -> tuple[list[float], float]:
        """Return the largest level of each channel, and the largest sum of their squares."""
        steady_levels = self._steady_levels()
        transitions = self._changing_magnitudes()
        times = _times_of_points(transitions, self._middle)
        mixed = _intervals_of_different_paces(transitions, times)
        count = len(times) + len(mixed)
        channel_levels = [[level] * count for level in steady_levels]
        for channel, transition in transitions:
            levels = [abs(transition.at(time)) for time in times]
            levels += [max(levels[number], levels[number + 1]) for number in mixed]
            channel_levels[channel] = [*map(add, channel_levels[channel], levels)]
        powers = []
        for levels_at_time in zip(*channel_levels, strict=True):
            powers.append(sum([level * level for level in levels_at_time]))
        return [*map(max, channel_levels)], max(powers)

    def _steady_levels(self) -> list[float]:
        """Return the sum of the peaks of each channel's unchanged and waiting voices.

        A waiting voice and the voice that it continues count once, with the higher peak.
        """
        levels = [0.0] * len(self._possible)
        continued_peaks: dict[tuple[int, int, float], float] = {}
        for channel, possible_voices in enumerate(self._possible):
            for possible in possible_voices:
                voice = possible.voice
                if possible.is_changed and not possible.is_waiting:
                    continue
                peak = voice.peak(self._since)
                if possible.continues or not (possible.is_waiting or voice.has_ended):
                    key = channel, voice.layer, voice.frequency
                    continued_peaks[key] = max(continued_peaks.get(key, 0.0), peak)
                else:
                    levels[channel] += peak
        for (channel, _, _), peak in continued_peaks.items():
            levels[channel] += peak
        return levels

    def _changing_magnitudes(self) -> list[tuple[int, VoiceTransition]]:
        """Return the channels of voices with new transitions, and these in magnitudes."""
        transitions = []
        for channel, possible_voices in enumerate(self._possible):
            for possible in possible_voices:
                if possible.is_changed and not possible.is_waiting:
                    transitions.append((channel, _magnitudes(possible)))
        return transitions

    def rise(self, channel: int) -> float:
        """Return the steepest rise of a level [full levels/s]; equal frequencies may beat."""
        slopes_by_frequency: dict[float, list[Slope]] = {}
        for possible in self._possible[channel]:
            slopes = slopes_by_frequency.setdefault(possible.voice.frequency, [])
            slopes.append(self._slope(possible))
            for layer_set in possible.layer_sets:
                # It may fade along the ramp of that set later.
                if layer_set.after or not possible.is_changed:
                    fade = along(None, 0.0, layer_set.ramp / _PER_RAMP, 0j, 0j)
                    slopes.append(_slope_from(possible.starts, fade))
        rise = 0.0
        for slopes in slopes_by_frequency.values():
            if len(slopes) == 1:
                rise += slopes[0].rise
            else:
                rise += sum([slope.change for slope in slopes])
        return rise

    def _slope(self, possible: _PossibleVoice) -> Slope:
        """Return the steepest slope of a voice, including its ending."""
        voice = possible.voice
        transition = voice.transition
        starts = possible.starts
        if possible.is_changed:
            slopes = [_slope_from(starts, transition)]
            starts = (*starts, *transition.knots, transition.last)
        else:
            # A steady voice counts too: another voice of its frequency may cease to cancel it.
            is_moving = transition.end > self._since
            change = transition.slope(self._since) if is_moving else 0.0
            is_falling_only = not (transition.last or transition.knots)
            slopes = [Slope(0.0 if is_falling_only else change, change)]
        if not voice.has_ended:
            if voice.ending is not None:
                slopes.append(_slope_from(starts, along(voice.ending, 0.0, 0.0, 0j, 0j)))
            elif not possible.is_changed and self._playback.end_of(voice.layer) < math.inf:
                ramp = self._playback.ramp_of(voice.layer)
                slopes.append(_slope_from(starts, along(None, 0.0, ramp, 0j, 0j)))
        rises, changes = zip(*slopes, strict=True)
        return Slope(max(rises), max(changes))


def _by_channel(layer_set: LayerSet) -> dict[int, Command]:
    return {command.channel: command for command in layer_set.commands}


def _magnitudes(possible: _PossibleVoice) -> VoiceTransition:
    """Return a transition in magnitudes; the voice's ending may begin before the transition ends.

    Then every point that the ending may replace counts with the peak of the ending.
    """
    voice = possible.voice
    transition = voice.transition
    ending_peak = 0.0 if voice.has_ended else peak_of(voice.ending)
    first = abs(transition.first)
    knots = [abs(knot) for knot in transition.knots]
    last = max(abs(transition.last), ending_peak)
    duration = (transition.end - transition.start) * _PER_VALID_FOR
    for layer_set in possible.layer_sets:
        if 0 < layer_set.valid_for < duration:
            first = max(first, ending_peak)
            knots = [max(knot, ending_peak) for knot in knots]
    return VoiceTransition(
        transition.start, transition.step, first, last, transition.end, tuple(knots)
    )


def _times_of_points(
    transitions: Sequence[tuple[int, VoiceTransition]], middle: float
) -> list[float]:
    """Return the times of all points of transitions, and the middle, in order [s]."""
    times = {middle}
    for _, transition in transitions:
        for number in range(len(transition.knots) + 2):
            times.add(transition.start + transition.step * number)
    return sorted(times)


def _intervals_of_different_paces(
    transitions: Sequence[tuple[int, VoiceTransition]], times: Sequence[float]
) -> list[int]:
    """Return the indices of the intervals between times in which transitions differ in pace.

    Transitions along an envelope move linearly; those along a ramp follow a raised cosine, whose
    pace depends on its duration.
    """
    paces = set()
    for _, transition in transitions:
        cosine_duration = None if transition.knots else transition.step
        paces.add((transition.end, cosine_duration))
    if len(paces) < 2:
        return []
    intervals = []
    for number, start in enumerate(times[:-1]):
        present = {duration for end, duration in paces if start < end}
        if len(present) > 1:
            intervals.append(number)
    return intervals


def _slope_from(starts: Sequence[complex], transition: VoiceTransition) -> Slope:
    """Return the steepest slope of a transition that starts from one of several amplitudes."""
    points = (*transition.knots, transition.last)
    lines = (*product(starts, points[:1]), *pairwise(points))
    return steepest(lines, transition.step, is_cosine=not transition.knots)


class PeakSums:
    """Upper bounds of the levels if the peaks of all possible voices occur simultaneously.

    Loops are plain and make few calls, because nearly every set is checked with it. Within a layer,
    the sum of a rising and a falling tone on the same ramp is at most the larger of the two, unless
    the new tone has an ending, which can begin during the ramp. A waiting tone that keeps its phase
    continues the voice it waits for.
    """

    def __init__(
        self, playback: Playback, layers: Sequence[LayerSet], since: float, until: float
    ) -> None:
        self.levels = [0.0] * playback.channels
        """Upper bound of each channel's level."""
        self._since = since
        self._rising: dict[tuple[int, int], float] = {}
        """Levels of tones that replace the voices of their layer, by layer and channel."""
        self._continuing: dict[tuple[int, int, float], int] = {}
        """Peaks of tones that continue a voice, in wire integers, by layer, channel, frequency."""
        for layer_set in (*layers, *playback.waiting):
            end = playback.end_of(layer_set.layer)
            is_immediate = not layer_set.after and until < playback.next_due
            is_continuing = layer_set.after and until < end
            for command in layer_set.commands:
                self._add_command(
                    layer_set.layer,
                    command,
                    is_immediate=is_immediate,
                    is_continuing=is_continuing and command.keep_phase,
                )
        for channel, voices in enumerate(playback.all_voices):
            for voice in voices:
                self._add_voice(channel, voice)

    def _add_command(
        self, layer: int, command: Command, *, is_immediate: bool, is_continuing: bool
    ) -> None:
        """Add the peak of a tone; is_continuing: whether it continues a voice of the layer."""
        peak = command.level
        for envelope in (command.onset, command.ending):
            if envelope is not None and envelope.knots:  # `Envelope.peak`, written out for speed
                peak = max(peak, max(envelope.knots)[0])
        if is_continuing:
            key = layer, command.channel, _FREQUENCY.from_wire(command.frequency)
            counted = self._continuing.get(key, 0)
            self._continuing[key] = max(counted, peak)
            peak -= min(counted, peak)
        self.levels[command.channel] += peak / _LEVEL.per_unit
        if is_immediate and command.onset is None and command.ending is None:
            self._rising[layer, command.channel] = command.level / _LEVEL.per_unit

    def _add_voice(self, channel: int, voice: Voice) -> None:
        """Add the peak of a voice, less what tones that replace or continue it have added."""
        transition = voice.transition
        peak = abs(transition.last)
        if self._since < transition.end:
            peak = max(peak, abs(transition.first), *map(abs, transition.knots))
        if voice.ending is not None and voice.ending.knots:
            peak = max(peak, max(voice.ending.knots)[0] / _LEVEL.per_unit)
        if not voice.has_ended:
            if self._continuing:
                key = voice.layer, channel, voice.frequency
                counted = self._continuing.pop(key, 0) / _LEVEL.per_unit
                peak = max(peak - counted, 0.0)
            if transition.last:
                counted = self._rising.pop((voice.layer, channel), 0.0)
                peak = max(peak - counted, 0.0)
        self.levels[channel] += peak
