"""What the channels of an amplifier play at a time: a pure function of sets and their commits.

A channel plays the sum of its voices (`drivers.playing.voices`), in a few layers. A simulated
amplifier asks this for samples, the ledger for the worst case, witness and conformance for what to
expect. Times [s] are of any one clock and never go back; levels and frequencies are of protocol 4.
Plain loops and few calls: every set is played by host and far end.
"""

import cmath
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain

from drivers.playing.voices import Voice, cut_to, voices_after
from drivers.protocol.definition import QUANTITIES
from drivers.protocol.records import Values
from drivers.protocol.sets import Command, LayerSet

__all__ = ["LAYERS_MAX", "Playback", "Voice", "playback_of"]

LAYERS_MAX = QUANTITIES["layer_count"].maximum
"""Layers of an amplifier, at the most."""
_LEVEL, _PHASE = QUANTITIES["level"], QUANTITIES["phase"]
_FREQUENCY, _SLEW = QUANTITIES["frequency"], QUANTITIES["slew"]
_PER_RAMP, _PER_VALID_FOR = QUANTITIES["ramp"].per_unit, QUANTITIES["valid_for"].per_unit


@dataclass
class _Layer:
    """What a layer plays: ends [s] by valid_for; waiting: a set that starts at a time [s]."""

    token: int = 0
    ramp: int = 0  # of the wire, as valid_for
    valid_for: int = 0
    ends: float = math.inf
    waiting: tuple[float, LayerSet, int] | None = None


@dataclass
class Playback:
    """Voices of all channels, and the layers that they belong to; silent at first.

    voices: how many a channel has for tones that are not cut short. slew: steepest change of a
    level that the amplifier has [full levels/s]. uncertainty [s]: by which commits may come sooner
    or later; fades begin at the largest amplitude within it, and layers end as late as they can, so
    that levels are upper bounds.
    """

    channels: int
    voices: int
    slew: float = math.inf
    uncertainty: float = 0.0
    next_due: float = field(default=math.inf, init=False)
    """Time of the next end of `valid_for`, or start of a set that waits [s]; infinite: none."""
    all_voices: list[tuple[Voice, ...]] = field(init=False)
    """Voices by channel, the oldest first."""
    _layers: dict[int, _Layer] = field(default_factory=dict)
    changes_at: float = field(default=math.inf, init=False)
    """Before this time [s] advancing changes nothing."""
    settles_at: float = field(default=-math.inf, init=False)
    """From this time [s] on nothing changes but by the ends of layers."""
    tokens: Mapping[int, int] = field(default_factory=dict, init=False)
    """Token of each layer that plays."""
    waiting: Sequence[LayerSet] = field(default_factory=list, init=False)
    """Sets of layers that start when onsets have ended."""

    def __post_init__(self) -> None:
        """Start silent."""
        self.all_voices = [()] * self.channels

    def copied(self) -> "Playback":
        """Return it as it is, to look ahead while the original stays."""
        copied = replace(self)
        copied.all_voices = [*self.all_voices]
        copied._layers = {number: replace(layer) for number, layer in self._layers.items()}
        copied._note_changes()
        return copied

    def commit(self, layers: Sequence[LayerSet], token: int, time: float) -> None:
        """Play a set from a time on."""
        if time >= self.changes_at:  # else without a call
            self.advance(time)
        for one in layers:
            layer = self._layers.setdefault(one.layer, _Layer())
            if one.renew:
                layer.ends = _end_of(one, time) + self.uncertainty
                continue
            start = self.onsets_end(one.layer, time) if one.after else time
            layer.waiting = (start, one, token) if start > time else None
            if start <= time:
                self._start(one, token, time)
        self._note_changes()

    def silence(self, time: float, ramp: float) -> None:
        """Fade all layers along a ramp [s], without endings; nothing waits any longer."""
        self.advance(time)
        self._layers.clear()
        self.all_voices = [
            tuple(voice.faded(time, ramp, self.uncertainty) for voice in voices)
            for voices in self.all_voices
        ]
        self._note_changes()

    def advance(self, time: float) -> None:
        """Carry out what is due by a time: ends of `valid_for`, sets that wait, faded voices."""
        if time < self.changes_at:
            return
        while self.next_due <= time:
            self.carry_out(*min(self.dues))
        self._drop_faded(time - self.uncertainty)
        self._note_changes()

    def carry_out(self, at: float, number: int) -> None:
        """End a layer at a time, or start what waits there; others may be due sooner."""
        layer = self._layers[number]
        # What has faded before is gone; a set that waited for its end may continue a voice.
        self._drop_faded(math.nextafter(at - self.uncertainty, -math.inf), number)
        if layer.waiting is not None and layer.waiting[0] <= at:
            _, one, token = layer.waiting
            layer.waiting = None
            self._start(one, token, at)
        else:
            self._end(number, at)
        self._note_changes()

    def _drop_faded(self, time: float, layer: int | None = None) -> None:
        """Drop the voices that are silent from a time on, of one layer or of all."""
        for channel, voices in enumerate(self.all_voices):
            kept = []
            for voice in voices:
                is_other = layer is not None and voice.layer != layer
                if is_other or voice.transition.last or voice.transition.end > time:
                    kept.append(voice)
            if len(kept) < len(voices):
                self.all_voices[channel] = tuple(kept)

    def _note_changes(self) -> None:
        """Note what plays, and when a voice has faded, or a layer ends or starts, next."""
        first, settles, waiting = math.inf, -math.inf, []
        for layer in self._layers.values():
            first = min(first, layer.ends)
            if layer.waiting is not None:
                first = min(first, layer.waiting[0])
                waiting.append(layer.waiting[1])
        self.next_due, self.waiting, tokens = first, waiting, {}
        for voices in self.all_voices:
            for voice in voices:
                end = voice.transition.end
                settles = max(settles, end)
                if not voice.transition.last and end < first:
                    first = end
                if not voice.has_ended:
                    tokens[voice.layer] = self._layers[voice.layer].token
        self.changes_at, self.settles_at, self.tokens = first, settles, tokens

    def add_ends(self, layer: int, time: float) -> None:
        """Add copies of the voices of a layer that end by themselves at a time [s].

        For bounds, where a set may have come before that or after.
        """
        ramp = self.ramp_of(layer)
        for channel, voices in enumerate(self.all_voices):
            ends = [
                each.ended(time, ramp, self.uncertainty)
                for each in voices
                if each.layer == layer and not each.has_ended
            ]
            self.all_voices[channel] = (*voices, *ends)

    def correct(self, one: LayerSet, token: int) -> None:
        """Have a layer lead to what an amplifier says it plays of the set with this token."""
        if one.layer not in self._layers or self._layers[one.layer].token != token:
            return
        commands = {command.channel: command for command in one.commands}
        for channel, voices in enumerate(self.all_voices):
            self.all_voices[channel] = tuple(
                voice
                if voice.layer != one.layer or voice.has_ended
                else voice.corrected(commands.get(channel))
                for voice in voices
            )
        self._note_changes()

    def scale(self, time: float, factor: float, ramp: float) -> None:
        """Take all tones that last to a factor of their level along a ramp [s], endings too."""
        self.advance(time)
        self.all_voices = [
            tuple(
                voice if voice.has_ended else voice.scaled(time, factor, ramp) for voice in voices
            )
            for voices in self.all_voices
        ]
        self._note_changes()

    def playing(self, layer: int) -> LayerSet:
        """Return the set to which the voices of a layer lead, without envelopes; empty: silent."""
        commands = tuple(
            Command(
                channel,
                _FREQUENCY.to_wire(voice.frequency),
                _LEVEL.to_wire(abs(voice.transition.last)),
                _PHASE.to_wire(math.degrees(cmath.phase(voice.transition.last))),
            )
            for channel, voices in enumerate(self.all_voices)
            for voice in voices
            if voice.layer == layer and not voice.has_ended
        )
        known = self._layers.get(layer, _Layer()) if commands else _Layer()
        return LayerSet(layer, known.ramp, known.valid_for, commands)

    def level(self, channel: int, time: float) -> float:
        """Return the largest amplitude of a channel; voices of one frequency interfere."""
        sums: dict[float, complex] = {}
        for voice in self.all_voices[channel]:
            amplitude = voice.transition.at(time)
            sums[voice.frequency] = sums.get(voice.frequency, 0j) + amplitude
        return sum(map(abs, sums.values()))

    def settled(self, channel: int) -> float:
        """Return the sum of the amplitudes to which the voices of a channel lead."""
        return sum(abs(voice.transition.last) for voice in self.all_voices[channel])

    def next_tokens(self, layer: int) -> set[int]:
        """Return the tokens that a layer may have now, or once what is due of it has happened."""
        known = self._layers.get(layer)
        waiting = () if known is None or known.waiting is None else known.waiting[2:]
        return {0, self.tokens.get(layer, 0), *waiting}

    def unsure(self, by: float, half: Sequence[float] = (0.0,) * LAYERS_MAX) -> set[int]:
        """Return the layers that end, or start what waits, by a time [s].

        half [s]: by how much sooner each may, for transitions by that of their own.
        """
        unsure = {layer for due, layer in self.dues if due - half[layer] <= by}
        for voice in chain.from_iterable(self.all_voices):
            way = voice.transition
            if not (way.last or voice.has_ended) and way.end - way.half <= by:
                unsure.add(voice.layer)
        return unsure

    @property
    def silent_from(self) -> float:
        """Time from which every channel is silent [s]; infinite while a tone lasts."""
        ends = [voice.silent_from for voices in self.all_voices for voice in voices]
        waits = any(layer.waiting is not None for layer in self._layers.values())
        return math.inf if waits else max(ends, default=-math.inf)

    def ramp_of(self, layer: int) -> float:
        """Return the ramp [s] along which a layer ends by itself."""
        return self._layers[layer].ramp / _PER_RAMP if layer in self._layers else 0.0

    def end_of(self, layer: int) -> float:
        """Return when a layer ends by itself [s]; infinite without `valid_for`."""
        known = self._layers.get(layer)
        return math.inf if known is None else known.ends

    @property
    def ends_by(self) -> float:
        """Latest time at which all is silent by itself [s]; infinite without `valid_for`."""
        latest = [voice.silent_from for voices in self.all_voices for voice in voices]
        ends = [end for end in latest if end < math.inf]
        for number, layer in self._layers.items():
            if layer.waiting is not None:
                return math.inf
            fades = [
                voice.ended(layer.ends, layer.ramp / _PER_RAMP).transition.end
                for voices in self.all_voices
                for voice in voices
                if voice.layer == number and not voice.has_ended and layer.ends < math.inf
            ]
            ends += fades or [layer.ends]
        return max(ends, default=-math.inf)

    def faded_from(self, time: float) -> float:
        """Return when the fades that go on at a time have ended [s], or that time."""
        ends = [
            voice.transition.end
            for voices in self.all_voices
            for voice in voices
            if voice.transition.last == 0
        ]
        return max([time, *ends])

    @property
    def dues(self) -> list[tuple[float, int]]:
        """When layers end by themselves or start what waits [s], the next of each, and which."""
        dues = []
        for number, layer in self._layers.items():
            due = layer.ends if layer.waiting is None else min(layer.ends, layer.waiting[0])
            if due < math.inf:
                dues.append((due, number))
        return dues

    def onsets_end(self, layer: int, time: float) -> float:
        """Return when the onsets with knots of a layer have ended [s]; a time without any."""
        ends = (
            voice.transition.end
            for voices in self.all_voices
            for voice in voices
            if voice.layer == layer and not voice.has_ended and voice.transition.knots
        )
        return max(ends, default=time)

    def _end(self, layer: int, time: float) -> None:
        """Let a layer fall silent by its endings."""
        ramp = self._layers.pop(layer).ramp / _PER_RAMP
        self.all_voices = [
            tuple(
                each.ended(time, ramp, self.uncertainty)
                if each.layer == layer and not each.has_ended
                else each
                for each in voices
            )
            for voices in self.all_voices
        ]

    def _start(self, one: LayerSet, token: int, time: float) -> None:
        commands: dict[int, Command] = {}
        for command in one.commands:
            commands[command.channel] = command
        ramp = one.ramp / _PER_RAMP
        after = voices_after(self.all_voices, one.layer, commands, time, ramp, self.uncertainty)
        for channel, voices in enumerate(after):
            if len(voices) > self.voices:
                voices = tuple(cut_to(voices, time, self.voices, self.slew))
            self.all_voices[channel] = voices
        if not commands:
            self._layers.pop(one.layer, None)
            return
        ends = _end_of(one, time) + self.uncertainty
        self._layers[one.layer] = _Layer(token, one.ramp, one.valid_for, ends)


def playback_of(capabilities: Values) -> Playback:
    """Return the playback of an amplifier with these capabilities, silent."""
    slew = _SLEW.from_wire(capabilities["slew"]) or math.inf
    return Playback(capabilities["channels"], capabilities["voices"], slew)


def _end_of(one: LayerSet, time: float) -> float:
    return time + one.valid_for / _PER_VALID_FOR if one.valid_for else math.inf
