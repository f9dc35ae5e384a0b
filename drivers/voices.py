"""Voices: the tones that sound in a channel, and how their amplitudes change over time.

A voice is a tone of a layer until it has faded. It sounds as

    Im[A(t) exp(2 pi i n clock(t) / 2^32)], A(t) along its transition, in full levels

The angle is the amplifier's clock (`drivers.protocol.definition`) times the frequency word n, so it
does not depend on the start of the voice. Amplitudes are complex, in full levels; times [s] refer
to one arbitrary clock. Loops are plain and make few calls, because both host and far end play every
set.
"""

import cmath
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import pairwise
from operator import attrgetter
from typing import NamedTuple

from drivers.protocol.definition import QUANTITIES, SHORTENED_FADE
from drivers.protocol.sets import Command, Envelope

_PER_STEP = QUANTITIES["envelope_step"].per_unit
_PER_FULL = QUANTITIES["level"].per_unit
_PER_DEGREE = QUANTITIES["phase"].per_unit
_PER_HERTZ = QUANTITIES["frequency"].per_unit
_SILENCE = Command(channel=0, frequency=0, level=0, phase=0)
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
    """Amplitude at its start."""
    last: complex
    """Amplitude at its end."""
    end: float
    """End time [s]."""
    knots: tuple[complex, ...] = ()

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


@dataclass(slots=True)  # not frozen, as above
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
