"""What the channels of an amplifier play at a time: a pure function of sets and their commits.

    Voice: Im[A(t) exp(2 pi i f (t - origin))], A(t) along its last transition, in full levels

A channel plays the sum of its voices, in a few layers. A simulated amplifier asks this for samples,
the ledger for the worst case, witness and conformance for what to expect. Times [s] are of any one
clock and never go back; levels and frequencies are of protocol 3.
"""

import cmath
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from operator import attrgetter

from drivers.protocol.sets import Command, Envelope, LayerSet
from drivers.protocol.table import QUANTITIES, SHORTENED_FADE

_LEVEL, _PHASE = QUANTITIES["level"], QUANTITIES["phase"]
_RAMP, _VALID_FOR = QUANTITIES["ramp"], QUANTITIES["valid_for"]
_STEP, _FREQUENCY = QUANTITIES["envelope_step"], QUANTITIES["frequency"]
_PER_FULL, _PER_DEGREE, _PER_HERTZ = _LEVEL.per_unit, _PHASE.per_unit, _FREQUENCY.per_unit


def amplitude_of(level: int, phase: int) -> complex:
    """Return the complex amplitude in full levels of a level and phase of the wire."""
    return cmath.rect(level / _PER_FULL, math.radians(phase / _PER_DEGREE))


def amplitudes_of(envelope: Envelope) -> tuple[complex, ...]:
    """Return the complex amplitudes of the knots of an envelope in full levels."""
    return tuple(amplitude_of(*knot) for knot in envelope.knots)


@dataclass(slots=True)  # frozen, each takes three times as long to make, and every set makes many
class Transition:
    """From one complex amplitude to another, from start [s] on.

    Along straight lines through knots a step [s] apart, or without knots along a raised cosine that
    lasts one step; a step of 0 changes at once.
    """

    start: float
    step: float
    first: complex
    last: complex
    knots: tuple[complex, ...] = ()
    end: float = field(init=False)
    """Time from which the amplitude is the last [s]."""

    def __post_init__(self) -> None:
        """Note the end, which is looked at often."""
        self.end = self.start + self.step * (len(self.knots) + 1)

    def at(self, time: float) -> complex:
        """Return the amplitude at a time [s], before start the first one."""
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
        """Return the amplitude at a time, or the largest within an uncertainty [s] around it."""
        if time - uncertainty >= self.end:
            return self.last
        if not uncertainty:
            return self.at(time)
        since, until = max(time - uncertainty, self.start), max(time + uncertainty, self.start)
        moments = (self.start + self.step * (index + 1) for index in range(len(self.knots)))
        between = [
            knot for moment, knot in zip(moments, self.knots, strict=True) if since < moment < until
        ]
        return max((self.at(since), *between, self.at(until)), key=abs)

    def peak(self, time: float) -> float:
        """Return the largest magnitude from a time on."""
        passed = math.floor((time - self.start) / self.step) if self.step else len(self.knots)
        points = (self.at(time), self.last, *self.knots[max(passed, 0) :])
        return max(map(abs, points))

    def slope(self, time: float) -> float:
        """Return the steepest change [full levels/s] from a time on; infinite for a jump."""
        if time >= self.end:
            return 0.0 if time > self.end or self.step else _steepest(self.first, self.last, 0.0)
        if not self.knots:
            return math.pi / 2 * _steepest(self.first, self.last, self.step)
        points = (self.first, *self.knots, self.last)
        passed = int((time - self.start) / self.step)
        pairs = zip(points[passed:], points[passed + 1 :], strict=False)
        return max(_steepest(one, other, self.step) for one, other in pairs)


def _steepest(first: complex, last: complex, time: float) -> float:
    if first == last:
        return 0.0
    return abs(last - first) / time if time else math.inf


@dataclass(frozen=True, slots=True)
class Voice:
    """A tone of a layer until it has faded: frequency [Hz], origin [s] of its phase.

    has_ended: it falls silent and nothing continues it, unlike an onset that leads to level 0.
    ending: how it falls silent, None for the ramp.
    """

    layer: int
    frequency: float
    origin: float
    transition: Transition
    has_ended: bool = False
    ending: Envelope | None = None

    @property
    def silent_from(self) -> float:
        """Time of silence [s]; infinite for a tone that lasts."""
        return math.inf if self.transition.last else self.transition.end

    def faded(self, time: float, ramp: float, uncertainty: float = 0.0) -> "Voice":
        """Return it falling silent along a ramp [s], or as it does if that is sooner.

        uncertainty [s]: see `Playback`.
        """
        if self.silent_from <= time + ramp:
            return replace(self, has_ended=True)
        transition = Transition(time, ramp, self.transition.reached(time, uncertainty), 0j)
        return replace(self, transition=transition, has_ended=True)

    def ended(self, time: float, ramp: float, uncertainty: float = 0.0) -> "Voice":
        """Return it falling silent along its ending, or along a ramp [s] without one."""
        if self.ending is None or self.has_ended:
            return self.faded(time, ramp, uncertainty)
        transition = _along(self.ending, time, self.transition.reached(time, uncertainty), 0j)
        return replace(self, transition=transition, has_ended=True)

    def scaled(self, time: float, factor: float, ramp: float) -> "Voice":
        """Return it led to a factor of its level along a ramp [s], its ending scaled too."""
        transition = self.transition
        led = Transition(time, ramp, transition.at(time), transition.last * factor)
        ending = None if self.ending is None else self.ending.scaled(factor)
        return replace(self, transition=led, ending=ending)

    def is_continued_by(self, command: Command) -> bool:
        """Whether a command of its layer continues it, unless it has ended."""
        is_same = self.frequency == command.frequency / _PER_HERTZ
        return command.keep_phase and is_same and command.is_driven


def _along(envelope: Envelope, time: float, first: complex, last: complex) -> Transition:
    return Transition(time, _STEP.from_wire(envelope.step), first, last, amplitudes_of(envelope))


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

    voices: how many a channel has for tones that are not cut short. uncertainty [s]: by which
    commits may come sooner or later; fades begin at the largest amplitude within it, and layers end
    as late as they can, so that levels are upper bounds.
    """

    channels: int
    voices: int
    uncertainty: float = 0.0
    _playing: list[tuple[Voice, ...]] = field(init=False)
    _layers: dict[int, _Layer] = field(default_factory=dict)
    _due: float = math.inf  # s; see `next_due`
    _changes_at: float = math.inf  # s; before, advancing changes nothing

    def __post_init__(self) -> None:
        """Start silent."""
        self._playing = [()] * self.channels

    def commit(self, layers: Sequence[LayerSet], token: int, time: float) -> None:
        """Play a set from a time on; what has a new tone counts its phase from there."""
        self.advance(time)
        for one in layers:
            layer = self._layers.setdefault(one.layer, _Layer())
            if one.renew:
                layer.ends = _end_of(one, time) + self.uncertainty
                continue
            start = self._onsets_end(one.layer, time) if one.after else time
            layer.waiting = (start, one, token) if start > time else None
            if start <= time:
                self._start(one, token, time)
        self._note_changes()

    def silence(self, time: float, ramp: float) -> None:
        """Fade all layers along a ramp [s], without endings; nothing waits any longer."""
        self.advance(time)
        self._layers.clear()
        self._playing = [
            tuple(voice.faded(time, ramp, self.uncertainty) for voice in voices)
            for voices in self._playing
        ]
        self._note_changes()

    def advance(self, time: float) -> None:
        """Carry out what is due by a time: ends of `valid_for`, sets that wait, faded voices."""
        if time < self._changes_at:
            return
        while (due := self._next_due()) is not None and due[0] <= time:
            at, number = due
            layer = self._layers[number]
            if layer.waiting is not None and layer.waiting[0] <= at:
                _, one, token = layer.waiting
                layer.waiting = None
                self._start(one, token, at)
            else:
                self._end(number, at)
        faded = time - self.uncertainty
        self._playing = [
            tuple([each for each in voices if each.transition.last or each.transition.end > faded])
            for voices in self._playing
        ]
        self._note_changes()

    def _note_changes(self) -> None:
        """Note when a voice has faded, or a layer ends or starts, next; plain loops: it is hot."""
        due = self._next_due()
        first = self._due = math.inf if due is None else due[0]
        for voices in self._playing:
            for voice in voices:
                if not voice.transition.last and voice.transition.end < first:
                    first = voice.transition.end
        self._changes_at = first

    def add_ends(self, layer: int, time: float) -> None:
        """Add copies of the voices of a layer that end by themselves at a time [s].

        For bounds, where a set may have come before that or after.
        """
        ramp = self.ramp_of(layer)
        for channel, voices in enumerate(self._playing):
            ends = [
                each.ended(time, ramp, self.uncertainty)
                for each in voices
                if each.layer == layer and not each.has_ended
            ]
            self._playing[channel] = (*voices, *ends)

    def scale(self, time: float, factor: float, ramp: float) -> None:
        """Take all tones that last to a factor of their level along a ramp [s], endings too."""
        self.advance(time)
        self._playing = [
            tuple(
                voice if voice.has_ended else voice.scaled(time, factor, ramp) for voice in voices
            )
            for voices in self._playing
        ]
        self._note_changes()

    @property
    def all_voices(self) -> Sequence[tuple[Voice, ...]]:
        """Voices by channel, the oldest first."""
        return self._playing

    def voices_of(self, channel: int) -> tuple[Voice, ...]:
        """Return the voices of a channel, the oldest first."""
        return self._playing[channel]

    def playing(self, layer: int) -> LayerSet:
        """Return the set to which the voices of a layer lead, without envelopes; empty: silent."""
        commands = tuple(
            Command(
                channel,
                _FREQUENCY.to_wire(voice.frequency),
                _LEVEL.to_wire(abs(voice.transition.last)),
                _PHASE.to_wire(math.degrees(cmath.phase(voice.transition.last))),
            )
            for channel, voices in enumerate(self._playing)
            for voice in voices
            if voice.layer == layer and not voice.has_ended
        )
        known = self._layers.get(layer, _Layer()) if commands else _Layer()
        return LayerSet(layer, known.ramp, known.valid_for, commands)

    def level(self, channel: int, time: float) -> float:
        """Return the largest amplitude of a channel; voices of one frequency interfere."""
        sums: dict[float, complex] = {}
        for voice in self._playing[channel]:
            turned = cmath.rect(1.0, -2 * math.pi * voice.frequency * voice.origin)
            amplitude = voice.transition.at(time) * turned
            sums[voice.frequency] = sums.get(voice.frequency, 0j) + amplitude
        return sum(map(abs, sums.values()))

    def settled(self, channel: int) -> float:
        """Return the sum of the amplitudes to which the voices of a channel lead."""
        return sum(abs(voice.transition.last) for voice in self._playing[channel])

    def peak(self, channel: int, time: float) -> float:
        """Return a bound of the amplitude from a time on: all voices at their largest at once."""
        return sum(voice.transition.peak(time) for voice in self._playing[channel])

    def slope(self, channel: int, time: float) -> float:
        """Return the steepest change of the sum [full levels/s] from a time on, at the most."""
        return sum(voice.transition.slope(time) for voice in self._playing[channel])

    @property
    def tokens(self) -> Mapping[int, int]:
        """Token of each layer that plays."""
        lasting = {
            voice.layer for voices in self._playing for voice in voices if not voice.has_ended
        }
        return {number: self._layers[number].token for number in sorted(lasting)}

    @property
    def waiting(self) -> tuple[LayerSet, ...]:
        """Sets of layers that start when onsets have ended."""
        return tuple([layer.waiting[1] for layer in self._layers.values() if layer.waiting])

    @property
    def next_due(self) -> float:
        """Time of the next end of `valid_for`, or start of a set that waits [s]; infinite: none."""
        return self._due

    @property
    def silent_from(self) -> float:
        """Time from which every channel is silent [s]; infinite while a tone lasts."""
        ends = [voice.silent_from for voices in self._playing for voice in voices]
        waits = any(layer.waiting is not None for layer in self._layers.values())
        return math.inf if waits else max(ends, default=-math.inf)

    def ramp_of(self, layer: int) -> float:
        """Return the ramp [s] along which a layer ends by itself."""
        return _RAMP.from_wire(self._layers[layer].ramp) if layer in self._layers else 0.0

    def end_of(self, layer: int) -> float:
        """Return when a layer ends by itself [s]; infinite without `valid_for`."""
        known = self._layers.get(layer)
        return math.inf if known is None else known.ends

    @property
    def ends_by(self) -> float:
        """Latest time at which all is silent by itself [s]; infinite without `valid_for`."""
        latest = [voice.silent_from for voices in self._playing for voice in voices]
        ends = [end for end in latest if end < math.inf]
        for number, layer in self._layers.items():
            if layer.waiting is not None:
                return math.inf
            fades = [
                voice.ended(layer.ends, _RAMP.from_wire(layer.ramp)).transition.end
                for voices in self._playing
                for voice in voices
                if voice.layer == number and not voice.has_ended and layer.ends < math.inf
            ]
            ends += fades or [layer.ends]
        return max(ends, default=-math.inf)

    def is_settled(self, time: float) -> bool:
        """Whether nothing changes from a time on [s] but by the ends of layers."""
        for voices in self._playing:
            for voice in voices:
                if voice.transition.end > time:
                    return False
        return True

    def _next_due(self) -> tuple[float, int] | None:
        first: tuple[float, int] | None = None
        for number, layer in self._layers.items():
            due = layer.ends if layer.waiting is None else min(layer.ends, layer.waiting[0])
            if due < math.inf and (first is None or due < first[0]):
                first = due, number
        return first

    def _onsets_end(self, layer: int, time: float) -> float:
        ends = (
            voice.transition.end
            for voices in self._playing
            for voice in voices
            if voice.layer == layer and not voice.has_ended and voice.transition.knots
        )
        return max(ends, default=time)

    def _end(self, layer: int, time: float) -> None:
        """Let a layer fall silent by its endings."""
        ramp = _RAMP.from_wire(self._layers.pop(layer).ramp)
        self._playing = [
            tuple(
                each.ended(time, ramp, self.uncertainty) if each.layer == layer else each
                for each in voices
            )
            for voices in self._playing
        ]

    def _start(self, one: LayerSet, token: int, time: float) -> None:
        commands = {command.channel: command for command in one.commands}
        ramp = _RAMP.from_wire(one.ramp)
        for channel, voices in enumerate(self._playing):
            command = commands.get(channel)
            if command is None and not voices:
                continue
            after = _after(voices, one.layer, command, time, ramp, self.uncertainty)
            if len(after) > self.voices:
                after = _within(after, time, self.voices)
            self._playing[channel] = tuple(after)
        if not commands:
            self._layers.pop(one.layer, None)
            return
        ends = _end_of(one, time) + self.uncertainty
        self._layers[one.layer] = _Layer(token, one.ramp, one.valid_for, ends)


def _end_of(one: LayerSet, time: float) -> float:
    return time + _VALID_FOR.from_wire(one.valid_for) if one.valid_for else math.inf


def _after(
    voices: Sequence[Voice],
    layer: int,
    command: Command | None,
    time: float,
    ramp: float,
    uncertainty: float,
) -> list[Voice]:
    """Return the voices of a channel once a command of a layer plays; None silences the layer."""
    is_driven = command is not None and command.is_driven
    continued = False
    after: list[Voice] = []
    for voice in voices:
        if voice.layer != layer or voice.has_ended:
            after.append(voice)
        elif command is not None and voice.is_continued_by(command):
            continued = True
            first = voice.transition.reached(time, uncertainty)
            transition = _towards(command, time, ramp, first)
            after.append(replace(voice, transition=transition, ending=command.ending))
        elif is_driven or (command is not None and command.skip_ending):
            after.append(voice.faded(time, ramp, uncertainty))
        else:
            after.append(voice.ended(time, ramp, uncertainty))
    if is_driven and command is not None and not continued:
        transition = _towards(command, time, ramp, 0j)
        frequency = command.frequency / _PER_HERTZ
        after.append(Voice(layer, frequency, time, transition, False, command.ending))
    return after


def _towards(command: Command, time: float, ramp: float, first: complex) -> Transition:
    last = amplitude_of(command.level, command.phase)
    if command.onset is None:
        return Transition(time, ramp, first, last)
    return _along(command.onset, time, first, last)


def _within(voices: Sequence[Voice], time: float, max_voices: int) -> list[Voice]:
    """Cut the oldest fades short where a channel has more voices than there are."""
    uncut = [voice for voice in voices if voice.silent_from > time + SHORTENED_FADE]
    fades = sorted(
        (voice for voice in uncut if voice.has_ended), key=attrgetter("transition.start")
    )
    cut = fades[: max(len(uncut) - max_voices, 0)]
    return [voice.faded(time, SHORTENED_FADE) if voice in cut else voice for voice in voices]
