"""Layers of an amplifier, and the output of its channels over time.

The host states `AmplifierLayer`s in physical units; the ledger (`drivers.host.ledger`) checks them
and rounds them to the integers of the wire. `Playback` depends only on these sets and their
commits. A channel plays the sum of its voices (`drivers.voices`). The simulated amplifier computes
samples from this, the ledger the worst case, and the conformance checks the expected output.

Amplitudes are complex, in full levels. Times [s] refer to one arbitrary clock and never decrease.
Loops are plain and make few calls, because both host and far end play every set.
"""

import cmath
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain

from drivers.protocol.definition import QUANTITIES
from drivers.protocol.records import Values
from drivers.protocol.sets import Command, Envelope, LayerSet
from drivers.voices import Voice, cut_to, voices_after

_PER_RAMP = QUANTITIES["ramp"].per_unit
_PER_VALID_FOR = QUANTITIES["valid_for"].per_unit
_LEVEL = QUANTITIES["level"]
_PHASE = QUANTITIES["phase"]
_FREQUENCY = QUANTITIES["frequency"]
_SLEW = QUANTITIES["slew"]
_STEP = QUANTITIES["envelope_step"]
LAYERS_MAX = QUANTITIES["layer_count"].maximum
"""Largest number of layers of an amplifier."""


@dataclass(frozen=True, slots=True)
class AmplifierTone:
    """Tone of a channel in a layer."""

    channel: int
    frequency: float
    """In Hz."""
    level: float
    """From 0 to 1, full level."""
    phase: float = 0.0
    """In degrees."""
    keep_phase: bool = False
    """Whether it continues the phase of the same frequency in this layer."""
    skip_ending: bool = False
    """Whether the tone before it falls silent along the layer's ramp, and not along its ending."""
    onset: Envelope | None = None
    """How it begins; None for the layer's ramp."""
    ending: Envelope | None = None
    """How it falls silent; None for the layer's ramp."""


@dataclass(frozen=True, slots=True)
class AmplifierLayer:
    """Content of a layer; channels without a tone are silent in it."""

    number: int
    tones: tuple[AmplifierTone, ...] = ()
    ramp: float = 0.02
    """Duration of all changes [s]."""
    valid_for: float = 0.0
    """Time after which the layer ends on its own [s]; 0 for never."""
    after: bool = False
    """Whether the tones start only when the onsets that the layer plays have ended."""
    renew: bool = False
    """Whether the layer, named without tones, goes on for another `valid_for`."""


@dataclass
class _Layer:
    """A set of a layer that plays, or that waits."""

    layer_set: LayerSet
    token: int = 0
    ends: float = math.inf
    """When it ends by `valid_for` [s]."""
    starts_at: float = -math.inf
    """When it starts [s], if it waits until the layer's onsets have ended."""
    waiting: "_Layer | None" = None
    """The set of the same layer that waits."""


@dataclass
class Playback:
    """The voices of all channels and the layers that they belong to; silent at first."""

    channels: int
    """Number of channels."""
    voices: int
    """How many voices a channel may have before the oldest fades are cut short."""
    slew: float = math.inf
    """The steepest change of a level that the amplifier can make [full levels/s]."""
    uncertainty: float = 0.0
    """By how much commits may come sooner or later [s].

    Fades begin at the largest amplitude within it, and layers end as late as they can, so that
    levels are upper bounds.
    """
    next_due: float = field(default=math.inf, init=False)
    """When a layer next ends by `valid_for` or starts a waiting set [s]; infinite if none does."""
    all_voices: list[tuple[Voice, ...]] = field(init=False)
    """Voices by channel, the oldest first."""
    _layers: dict[int, _Layer] = field(default_factory=dict)
    changes_at: float = field(default=math.inf, init=False)
    """Before this time [s] advancing changes nothing."""
    settles_at: float = field(default=-math.inf, init=False)
    """From this time [s] on, only the ends of layers change anything."""
    settled_levels: Sequence[float] = field(default_factory=list, init=False)
    """Sums of the amplitudes to which the voices of each channel lead."""
    tokens: Mapping[int, int] = field(default_factory=dict, init=False)
    """Token of each layer that plays."""
    waiting: Sequence[LayerSet] = field(default_factory=list, init=False)
    """Sets of layers that start when onsets have ended."""

    def __post_init__(self) -> None:
        """Start silent."""
        self.all_voices = [()] * self.channels
        self._note_changes()

    def copied(self) -> "Playback":
        """Return a copy, with which one can look ahead."""
        copied = replace(self)
        copied.all_voices = [*self.all_voices]
        copied._layers = {number: replace(layer) for number, layer in self._layers.items()}
        copied._note_changes()
        return copied

    def commit(self, layers: Sequence[LayerSet], token: int, time: float) -> None:
        """Play a set from a time [s] on."""
        if time >= self.changes_at:  # otherwise the call would change nothing
            self.advance(time)
        for layer_set in layers:
            layer = self._layers.setdefault(layer_set.layer, _silent(layer_set.layer))
            if layer_set.renew:
                layer.ends = _end_of(layer_set, time) + self.uncertainty
                continue
            start = self.onsets_end(layer_set.layer, time) if layer_set.after else time
            layer.waiting = None
            if start > time:
                layer.waiting = _Layer(layer_set, token, starts_at=start)
            else:
                self._start(layer_set, token, time)
        self._note_changes()

    def silence(self, time: float, ramp: float) -> None:
        """Fade all layers along a ramp [s] without their endings, and drop waiting sets."""
        self.advance(time)
        self._layers.clear()
        for channel, voices in enumerate(self.all_voices):
            faded = [voice.faded(time, ramp, self.uncertainty) for voice in voices]
            self.all_voices[channel] = tuple(faded)
        self._note_changes()

    def advance(self, time: float) -> None:
        """Carry out everything due by a time [s]: ends of layers, starts of sets, faded voices."""
        if time < self.changes_at:
            return
        while self.next_due <= time:
            self.carry_out(*min(self.dues))
        self._drop_faded(time - self.uncertainty)
        self._note_changes()

    def carry_out(self, at: float, number: int) -> None:
        """End a layer at a time [s], or start its waiting set; other layers may be due sooner."""
        layer = self._layers[number]
        # Voices that faded earlier are dropped. A voice that fades right now is kept, because a set
        # that waited for its end can continue it.
        self._drop_faded(math.nextafter(at - self.uncertainty, -math.inf), number)
        waiting = layer.waiting
        if waiting is not None and waiting.starts_at <= at:
            layer.waiting = None
            self._start(waiting.layer_set, waiting.token, at)
        else:
            self._end(number, at)
        self._note_changes()

    def _drop_faded(self, time: float, layer: int | None = None) -> None:
        """Drop voices that are silent from a time [s]; layer: only its voices, None for all."""
        for channel, voices in enumerate(self.all_voices):
            remaining = []
            for voice in voices:
                is_other = layer is not None and voice.layer != layer
                if is_other or voice.transition.last or voice.transition.end > time:
                    remaining.append(voice)
            if len(remaining) < len(voices):
                self.all_voices[channel] = tuple(remaining)

    def _note_changes(self) -> None:
        """Update the voices, and the time of the next fade, end or start."""
        first = math.inf
        settles = -math.inf
        waiting = []
        for layer in self._layers.values():
            first = min(first, layer.ends)
            if layer.waiting is not None:
                first = min(first, layer.waiting.starts_at)
                waiting.append(layer.waiting.layer_set)
        self.next_due = first
        self.waiting = waiting
        tokens = {}
        settled_levels = []
        for voices in self.all_voices:
            settled_level = 0.0
            for voice in voices:
                settled_level += abs(voice.transition.last)
                end = voice.transition.end
                settles = max(settles, end)
                if not voice.transition.last and end < first:
                    first = end
                if not voice.has_ended:
                    tokens[voice.layer] = self._layers[voice.layer].token
            settled_levels.append(settled_level)
        self.settled_levels = settled_levels
        self.changes_at = first
        self.settles_at = settles
        self.tokens = tokens

    def add_ends(self, layer: int, time: float) -> None:
        """Add copies of the voices of a layer that fall silent at a time [s].

        Bounds need both, if a set may have come before or after the end of the layer.
        """
        ramp = self.ramp_of(layer)
        for channel, voices in enumerate(self.all_voices):
            ends = []
            for voice in voices:
                if voice.layer == layer and not voice.has_ended:
                    ends.append(voice.ended(time, ramp, self.uncertainty))
            self.all_voices[channel] = (*voices, *ends)

    def correct(self, achieved: LayerSet, token: int) -> None:
        """Correct a layer to the playback reported by an amplifier for the set with this token."""
        layer = achieved.layer
        if layer not in self._layers or self._layers[layer].token != token:
            return
        commands = {command.channel: command for command in achieved.commands}
        for channel, voices in enumerate(self.all_voices):
            corrected = []
            for voice in voices:
                if voice.layer == layer and not voice.has_ended:
                    voice = voice.corrected(commands.get(channel))
                corrected.append(voice)
            self.all_voices[channel] = tuple(corrected)
        self._note_changes()

    def scale(self, time: float, factor: float, ramp: float) -> None:
        """Scale all lasting tones and their endings by a factor, along a ramp [s].

        Sets that wait until an onset has ended start at the scaled levels.
        """
        self.advance(time)
        for layer in self._layers.values():
            if layer.waiting is not None:
                scaled_set = layer.waiting.layer_set.scaled(factor)
                layer.waiting = replace(layer.waiting, layer_set=scaled_set)
        for channel, voices in enumerate(self.all_voices):
            scaled = []
            for voice in voices:
                scaled.append(voice if voice.has_ended else voice.scaled(time, factor, ramp))
            self.all_voices[channel] = tuple(scaled)
        self._note_changes()

    def playing(self, layer: int) -> LayerSet:
        """Return the target set of a layer's voices, without envelopes; empty if silent."""
        commands = []
        for channel, voices in enumerate(self.all_voices):
            for voice in voices:
                if voice.layer == layer and not voice.has_ended:
                    last = voice.transition.last
                    frequency = _FREQUENCY.to_wire(voice.frequency)
                    level = _LEVEL.to_wire(abs(last))
                    phase = _PHASE.to_wire(math.degrees(cmath.phase(last)))
                    commands.append(Command(channel, frequency, level, phase))
        state = self._layers.get(layer) if commands else None
        if state is None:
            state = _silent(layer)
        return LayerSet(layer, state.layer_set.ramp, state.layer_set.valid_for, tuple(commands))

    def level(self, channel: int, time: float) -> float:
        """Return the largest amplitude of a channel; voices of equal frequency interfere."""
        sums: dict[float, complex] = {}
        for voice in self.all_voices[channel]:
            amplitude = voice.transition.at(time)
            sums[voice.frequency] = sums.get(voice.frequency, 0j) + amplitude
        return sum(map(abs, sums.values()))

    def next_tokens(self, layer: int) -> set[int]:
        """Return the possible tokens of a layer, now or after its due changes."""
        tokens = {0, self.tokens.get(layer, 0)}
        state = self._layers.get(layer)
        if state is not None and state.waiting is not None:
            tokens.add(state.waiting.token)
        return tokens

    def unsure(self, by: float) -> set[int]:
        """Return the layers that may end or start a waiting set by a time [s]."""
        unsure = {layer for due, layer in self.dues if due <= by}
        for voice in chain.from_iterable(self.all_voices):
            transition = voice.transition
            is_falling = not (transition.last or voice.has_ended)
            if is_falling and transition.end <= by:
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
        return self._layers.get(layer, _silent(layer)).layer_set.ramp / _PER_RAMP

    def end_of(self, layer: int) -> float:
        """Return when a layer ends by itself [s]; infinite without `valid_for`."""
        state = self._layers.get(layer)
        return math.inf if state is None else state.ends

    @property
    def ends_by(self) -> float:
        """Latest time at which all is silent by itself [s]; infinite without `valid_for`."""
        ends = []
        for voice in chain.from_iterable(self.all_voices):
            if voice.silent_from < math.inf:
                ends.append(voice.silent_from)
        for number, layer in self._layers.items():
            if layer.waiting is not None:
                ends.append(self._waiting_ends_by(layer.waiting))
            if layer.ends < math.inf or self._lasts(number):
                ends += self._fade_ends(number, layer) or [layer.ends]
        return max(ends, default=-math.inf)

    def _waiting_ends_by(self, waiting: _Layer) -> float:
        """Return when a set that waits has faded at the latest [s], if no other set follows."""
        layer_set = waiting.layer_set
        end = _end_of(layer_set, waiting.starts_at) + self.uncertainty
        return end + fade_of(layer_set)

    def _lasts(self, number: int) -> bool:
        """Whether a layer has a tone that lasts; tones at level 0 do not."""
        return any(
            voice.layer == number and voice.silent_from == math.inf
            for voice in chain.from_iterable(self.all_voices)
        )

    def _fade_ends(self, number: int, layer: _Layer) -> list[float]:
        """Return when the voices of a layer have faded [s] after it ends by itself."""
        ends: list[float] = []
        if layer.ends == math.inf:
            return ends
        ramp = self.ramp_of(number)
        for voice in chain.from_iterable(self.all_voices):
            if voice.layer == number and not voice.has_ended:
                ends.append(voice.ended(layer.ends, ramp).transition.end)
        return ends

    def faded_from(self, time: float) -> float:
        """Return when the fades that go on at a time have ended [s]; without fades that time."""
        end = time
        for voice in chain.from_iterable(self.all_voices):
            if voice.transition.last == 0:
                end = max(end, voice.transition.end)
        return end

    @property
    def dues(self) -> list[tuple[float, int]]:
        """Time [s] when each layer next ends or starts its waiting set, and its number."""
        dues = []
        for number, layer in self._layers.items():
            due = layer.ends
            if layer.waiting is not None:
                due = min(due, layer.waiting.starts_at)
            if due < math.inf:
                dues.append((due, number))
        return dues

    def onsets_end(self, layer: int, time: float) -> float:
        """Return the end [s] of a layer's onsets with knots; `time` without any."""
        ends = []
        for voice in chain.from_iterable(self.all_voices):
            if voice.layer == layer and not voice.has_ended and voice.transition.knots:
                ends.append(voice.transition.end)
        return max(ends, default=time)

    def _end(self, layer: int, time: float) -> None:
        """Let a layer fall silent along its endings."""
        ramp = self._layers.pop(layer).layer_set.ramp / _PER_RAMP
        for channel, voices in enumerate(self.all_voices):
            ended = []
            for voice in voices:
                if voice.layer == layer and not voice.has_ended:
                    voice = voice.ended(time, ramp, self.uncertainty)
                ended.append(voice)
            self.all_voices[channel] = tuple(ended)

    def _start(self, layer_set: LayerSet, token: int, time: float) -> None:
        commands: dict[int, Command] = {}
        for command in layer_set.commands:
            commands[command.channel] = command
        ramp = layer_set.ramp / _PER_RAMP
        after = voices_after(
            self.all_voices, layer_set.layer, commands, time, ramp, self.uncertainty
        )
        for channel, voices in enumerate(after):
            if len(voices) > self.voices:
                voices = tuple(cut_to(voices, time, self.voices, self.slew))
            self.all_voices[channel] = voices
        if not commands:
            self._layers.pop(layer_set.layer, None)
            return
        ends = _end_of(layer_set, time) + self.uncertainty
        self._layers[layer_set.layer] = _Layer(layer_set, token, ends)


def playback_of(capabilities: Values) -> Playback:
    """Return the silent playback of an amplifier with these capabilities."""
    slew = _SLEW.from_wire(capabilities["slew"]) or math.inf
    return Playback(capabilities["channels"], capabilities["voices"], slew)


def _silent(layer: int) -> _Layer:
    """Return the state of a layer in which nothing plays."""
    return _Layer(LayerSet(layer, ramp=0, valid_for=0))


def fade_of(layer_set: LayerSet) -> float:
    """Return how long a layer takes to end [s], along its ramp or its longest ending."""
    fade = layer_set.ramp / _PER_RAMP
    for command in layer_set.commands:
        if command.ending is not None:
            steps = len(command.ending.knots) + 1
            fade = max(fade, _STEP.from_wire(command.ending.step) * steps)
    return fade


def _end_of(layer_set: LayerSet, time: float) -> float:
    return time + layer_set.valid_for / _PER_VALID_FOR if layer_set.valid_for else math.inf
