"""Tones and layers of an amplifier, and the output of its channels over time.

The host states `AmplifierLayer`s in physical units; the ledger (`drivers.host.ledger`) checks them
and rounds them to the integers of the wire. `Playback` depends only on these sets and their
commits. A channel plays the sum of its voices. A voice is a tone of a layer until it has faded:

    Im[A(t) exp(2 pi i n clock(t) / 2^32)], A(t) along its transition, in full levels

The angle is the amplifier's clock (`drivers.protocol.definition`) times the frequency word n, so it
does not depend on the start of the voice. The simulated amplifier computes samples from this, the
ledger the worst case, and the conformance checks the expected output.

Amplitudes are complex, in full levels. Times [s] refer to one arbitrary clock and never decrease.
Loops are plain and make few calls, because both host and far end play every set.
"""

import cmath
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from itertools import chain, pairwise
from operator import attrgetter
from typing import NamedTuple

from drivers.protocol.definition import QUANTITIES, SHORTENED_FADE
from drivers.protocol.records import Values
from drivers.protocol.sets import Command, Envelope, LayerSet

_PER_STEP = QUANTITIES["envelope_step"].per_unit
_PER_FULL = QUANTITIES["level"].per_unit
_PER_DEGREE = QUANTITIES["phase"].per_unit
_PER_HERTZ = QUANTITIES["frequency"].per_unit
_SILENCE = Command(channel=0, frequency=0, level=0, phase=0)
_PER_RAMP = QUANTITIES["ramp"].per_unit
_PER_VALID_FOR = QUANTITIES["valid_for"].per_unit
_LEVEL = QUANTITIES["level"]
_PHASE = QUANTITIES["phase"]
_FREQUENCY = QUANTITIES["frequency"]
_SLEW = QUANTITIES["slew"]
LAYERS_MAX = QUANTITIES["layer_count"].maximum
"""Largest number of layers of an amplifier."""
SAME = 1e-6
"""Ends of fades that are closer than this count as equal, so that rounding decides nothing [s]."""


@lru_cache(maxsize=256)  # limits, playback and commit of a set each ask for the same command
def amplitude_of(level: int, phase: int) -> complex:
    """Return the complex amplitude in full levels of a level and phase of the wire."""
    return _amplitudes_at([(level, phase)])[0]


@lru_cache(maxsize=256)  # a set names an envelope several times, and its commit does again
def _amplitudes_of(envelope: Envelope | None) -> tuple[complex, ...]:
    """Return the complex amplitudes of the knots of an envelope in full levels, if any."""
    return () if envelope is None else _amplitudes_at(envelope.knots)


def _amplitudes_at(knots: Sequence[tuple[int, ...]]) -> tuple[complex, ...]:
    amplitudes = []
    for level, phase in knots:
        amplitudes.append(cmath.rect(level / _PER_FULL, math.radians(phase / _PER_DEGREE)))
    return tuple(amplitudes)


def peak_of(envelope: Envelope | None) -> float:
    """Return the largest magnitude of the knots of an envelope in full levels; 0 without one."""
    return 0.0 if envelope is None else envelope.peak / _PER_FULL


@dataclass(slots=True)  # not frozen, which would take three times as long to make
class VoiceTransition:
    """Transition of a voice from one complex amplitude to another.

    Follows straight lines through its knots or, without knots, a raised cosine over a step.
    """

    start: float
    """Start time [s]."""
    step: float
    """Time between two knots, or duration of the raised cosine [s]; 0 changes immediately."""
    first: complex
    last: complex
    end: float
    """End time [s], when it reaches the last amplitude."""
    knots: tuple[complex, ...] = ()
    half: float = 0.0
    """Tolerance of its start [s], see `era_haptics.lab.expected_output`."""
    radius: float = 0.0
    """Tolerance of its first amplitude."""

    def at(self, time: float) -> complex:
        """Return the amplitude at a time [s]; before the start it is the first one."""
        if time >= self.end:
            return self.last
        if time <= self.start:
            return self.first
        steps = (time - self.start) / self.step
        if not self.knots:
            return self.first + (self.last - self.first) * (1 - math.cos(math.pi * steps)) / 2
        points = (self.first, *self.knots, self.last)
        index = int(steps)
        return points[index] + (points[index + 1] - points[index]) * (steps - index)

    def reached(self, time: float, uncertainty: float) -> complex:
        """Return the largest amplitude within an uncertainty [s] around a time [s]."""
        if time - uncertainty >= self.end:
            return self.last
        if not uncertainty:
            return self.at(time)
        since = max(time - uncertainty, self.start)
        until = max(time + uncertainty, self.start)
        return max(self.points(since, until), key=abs)

    def points(self, since: float, until: float = math.inf) -> tuple[complex, ...]:
        """Return the amplitudes at two times [s] and at the knots between them.

        All other amplitudes between these times are between two listed ones.
        """
        between = []
        for number, knot in enumerate(self.knots, 1):
            if since < self.start + self.step * number < until:
                between.append(knot)
        return (self.at(since), *between, self.at(until))

    def peak(self, time: float) -> float:
        """Return the largest magnitude from a time on."""
        if time <= self.start:  # the usual case: it was committed just now
            return max(map(abs, (self.first, *self.knots, self.last)))
        return max(map(abs, self.points(time)))

    def slope(self, time: float) -> float:
        """Return the steepest change [full levels/s] from a time on; infinite for a jump."""
        if time >= self.end and (time > self.end or self.step):
            return 0.0
        points = (self.first, *self.knots, self.last)
        passed = max(0, int((time - self.start) / self.step)) if self.knots else 0
        lines = pairwise(points[passed:])
        return steepest(lines, self.step, is_cosine=not self.knots).change


def along(
    envelope: Envelope | None, time: float, ramp: float, first: complex, last: complex
) -> VoiceTransition:
    """Return a transition from a time [s] on: along an envelope, or a ramp [s] without one."""
    if envelope is None:
        return VoiceTransition(time, ramp, first, last, time + ramp)
    step = envelope.step / _PER_STEP
    end = time + step * (len(envelope.knots) + 1)
    return VoiceTransition(time, step, first, last, end, _amplitudes_of(envelope))


class Slope(NamedTuple):
    """How fast an amplitude changes at most."""

    rise: float
    """The steepest rise of its magnitude [full levels/s]."""
    change: float
    """Its fastest change in the complex plane [full levels/s]."""


def steepest(lines: Iterable[tuple[complex, complex]], step: float, *, is_cosine: bool) -> Slope:
    """Return the steepest slope on lines between two points.

    Each line takes a step [s] and is followed linearly or along a raised cosine.
    """
    max_rise = max_change = 0.0
    for start, end in lines:
        if start == end:
            continue
        change = abs(end - start) / step if step else math.inf
        max_change = max(max_change, change)
        # The magnitude rises only if the end is farther out than the foot of the perpendicular.
        if ((end - start) * end.conjugate()).real > 0:
            max_rise = max(max_rise, change)
    factor = math.pi / 2 if is_cosine else 1.0
    return Slope(max_rise * factor, max_change * factor)


@dataclass(frozen=True, slots=True)
class Voice:
    """A tone of a layer until it has faded."""

    layer: int
    frequency: float
    """In Hz."""
    began: float
    """When it began [s]."""
    transition: VoiceTransition
    has_ended: bool = False
    """Whether it is falling silent for good, unlike an onset that leads to level 0."""
    ending: Envelope | None = None
    """How it falls silent; None for the ramp of its layer."""

    @property
    def silent_from(self) -> float:
        """When it is silent [s]; infinite for a tone that lasts."""
        return math.inf if self.transition.last else self.transition.end

    def peak(self, time: float) -> float:
        """Return the largest magnitude from a time on, including its ending."""
        return max(self.transition.peak(time), peak_of(self.ending))

    def faded(self, time: float, ramp: float, uncertainty: float = 0.0) -> "Voice":
        """Return it as it falls silent along a ramp [s], or on its present way if that ends sooner.

        uncertainty: see `Playback` [s]. If it is uncertain which ends sooner, the largest amplitude
        of both lasts until both are over.
        """
        transition = self.transition
        end = time + ramp
        if transition.last or transition.end > end + uncertainty + SAME:
            is_over = time - uncertainty >= transition.end
            first = transition.last if is_over else transition.reached(time, uncertainty)
            transition = VoiceTransition(time, ramp, first, 0j, end)
        elif uncertainty and transition.end > end - uncertainty:
            peak = transition.peak(time - uncertainty)
            last_end = max(transition.end, end)
            transition = VoiceTransition(last_end, 0.0, complex(peak), 0j, last_end)
        return Voice(self.layer, self.frequency, self.began, transition, True, self.ending)

    def ended(self, time: float, ramp: float, uncertainty: float = 0.0) -> "Voice":
        """Return it as it falls silent along its ending, or without one along a ramp [s]."""
        if self.ending is None or self.has_ended:
            return self.faded(time, ramp, uncertainty)
        first = self.transition.reached(time, uncertainty)
        return replace(self, transition=along(self.ending, time, ramp, first, 0j), has_ended=True)

    def scaled(self, time: float, factor: float, ramp: float) -> "Voice":
        """Return it with its level and its ending scaled by a factor, along a ramp [s]."""
        transition = self.transition
        last = transition.last * factor
        scaled = VoiceTransition(time, ramp, transition.at(time), last, time + ramp)
        ending = None if self.ending is None else self.ending.scaled(factor)
        return replace(self, transition=scaled, ending=ending)

    def corrected(self, command: Command | None) -> "Voice":
        """Return it as it leads to the level and phase of a command; None: to silence."""
        if command is None:
            return replace(self, transition=replace(self.transition, last=0j))
        last = amplitude_of(command.level, command.phase)
        frequency = command.frequency / _PER_HERTZ
        return replace(self, frequency=frequency, transition=replace(self.transition, last=last))


def voices_after(
    channels: Sequence[Sequence[Voice]],
    layer: int,
    commands: Mapping[int, Command],
    time: float,
    ramp: float,
    uncertainty: float,
) -> list[tuple[Voice, ...]]:
    """Return the voices of all channels after a layer has been set to commands by channel.

    The layer falls silent in each channel without a command.
    """
    all_after: list[tuple[Voice, ...]] = []
    for channel, voices in enumerate(channels):
        command = commands.get(channel, _SILENCE)
        # This is `Command.is_driven`, written out for speed.
        is_driven = command.level > 0 or command.onset is not None
        is_new = is_driven
        last = amplitude_of(command.level, command.phase)
        frequency = command.frequency / _PER_HERTZ
        voices_now: list[Voice] = []
        for voice in voices:
            if voice.layer != layer or voice.has_ended:
                voices_now.append(voice)
            elif is_driven and command.keep_phase and voice.frequency == frequency:
                is_new = False
                first = voice.transition.reached(time, uncertainty)
                transition = along(command.onset, time, ramp, first, last)
                voices_now.append(replace(voice, transition=transition, ending=command.ending))
            elif is_driven or command.skip_ending:
                voices_now.append(voice.faded(time, ramp, uncertainty))
            else:
                voices_now.append(voice.ended(time, ramp, uncertainty))
        if is_new:
            transition = VoiceTransition(time, ramp, 0j, last, time + ramp)
            if command.onset is not None:  # this is rare, so the usual case is without a call
                transition = along(command.onset, time, ramp, 0j, last)
            voices_now.append(Voice(layer, frequency, time, transition, False, command.ending))
        all_after.append(tuple(voices_now))
    return all_after


def cut_to(voices: Sequence[Voice], time: float, max_voices: int, slew: float) -> list[Voice]:
    """Cut the oldest fades short if a channel has more than `max_voices`.

    slew: the steepest change of a level that the amplifier can make [full levels/s].
    """
    uncut = [voice for voice in voices if voice.silent_from > time + SHORTENED_FADE]
    fades = sorted(
        (voice for voice in uncut if voice.has_ended), key=attrgetter("transition.start")
    )
    cut = fades[: max(len(uncut) - max_voices, 0)]
    return [_cut_short(voice, time, slew) if voice in cut else voice for voice in voices]


def _cut_short(voice: Voice, time: float, slew: float) -> Voice:
    """Let a voice fall silent as soon as the slew allows."""
    # A raised cosine is steepest in the middle.
    steepest_fade = math.pi / 2 * abs(voice.transition.at(time)) / slew
    return voice.faded(time, max(SHORTENED_FADE, steepest_fade))


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


class _WaitingLayer(NamedTuple):
    """A committed set of a layer that starts once the layer's onsets have ended."""

    starts_at: float
    """In s."""
    layer_set: LayerSet
    token: int


@dataclass
class _Layer:
    """Playback state of a layer."""

    token: int = 0
    ramp: int = 0  # in units of the wire
    valid_for: int = 0  # in units of the wire
    ends: float = math.inf  # s; by `valid_for`
    waiting: _WaitingLayer | None = None


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
    tokens: Mapping[int, int] = field(default_factory=dict, init=False)
    """Token of each layer that plays."""
    waiting: Sequence[LayerSet] = field(default_factory=list, init=False)
    """Sets of layers that start when onsets have ended."""

    def __post_init__(self) -> None:
        """Start silent."""
        self.all_voices = [()] * self.channels

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
            layer = self._layers.setdefault(layer_set.layer, _Layer())
            if layer_set.renew:
                layer.ends = _end_of(layer_set, time) + self.uncertainty
                continue
            start = self.onsets_end(layer_set.layer, time) if layer_set.after else time
            layer.waiting = _WaitingLayer(start, layer_set, token) if start > time else None
            if start <= time:
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
        for voices in self.all_voices:
            for voice in voices:
                end = voice.transition.end
                settles = max(settles, end)
                if not voice.transition.last and end < first:
                    first = end
                if not voice.has_ended:
                    tokens[voice.layer] = self._layers[voice.layer].token
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
        """Scale all lasting tones and their endings by a factor, along a ramp [s]."""
        self.advance(time)
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
        state = self._layers.get(layer, _Layer()) if commands else _Layer()
        return LayerSet(layer, state.ramp, state.valid_for, tuple(commands))

    def level(self, channel: int, time: float) -> float:
        """Return the largest amplitude of a channel; voices of equal frequency interfere."""
        sums: dict[float, complex] = {}
        for voice in self.all_voices[channel]:
            amplitude = voice.transition.at(time)
            sums[voice.frequency] = sums.get(voice.frequency, 0j) + amplitude
        return sum(map(abs, sums.values()))

    def settled(self, channel: int) -> float:
        """Return the sum of the amplitudes to which the voices of a channel lead."""
        return sum(abs(voice.transition.last) for voice in self.all_voices[channel])

    def next_tokens(self, layer: int) -> set[int]:
        """Return the possible tokens of a layer, now or after its due changes."""
        tokens = {0, self.tokens.get(layer, 0)}
        state = self._layers.get(layer)
        if state is not None and state.waiting is not None:
            tokens.add(state.waiting.token)
        return tokens

    def unsure(self, by: float, half: Sequence[float] = (0.0,) * LAYERS_MAX) -> set[int]:
        """Return the layers that may end or start a waiting set by a time [s].

        half: by how much sooner each layer may do so [s]; transitions have a value of their own.
        """
        unsure = {layer for due, layer in self.dues if due - half[layer] <= by}
        for voice in chain.from_iterable(self.all_voices):
            transition = voice.transition
            is_falling = not (transition.last or voice.has_ended)
            if is_falling and transition.end - transition.half <= by:
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
                return math.inf
            if layer.ends < math.inf or self._lasts(number):
                ends += self._fade_ends(number, layer) or [layer.ends]
        return max(ends, default=-math.inf)

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
        ramp = self._layers.pop(layer).ramp / _PER_RAMP
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
        self._layers[layer_set.layer] = _Layer(token, layer_set.ramp, layer_set.valid_for, ends)


def playback_of(capabilities: Values) -> Playback:
    """Return the silent playback of an amplifier with these capabilities."""
    slew = _SLEW.from_wire(capabilities["slew"]) or math.inf
    return Playback(capabilities["channels"], capabilities["voices"], slew)


def _end_of(layer_set: LayerSet, time: float) -> float:
    return time + layer_set.valid_for / _PER_VALID_FOR if layer_set.valid_for else math.inf
