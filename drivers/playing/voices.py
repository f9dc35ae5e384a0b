"""Voices of one channel: the tones that it plays at once, in any layers, until they have faded.

    Voice: Im[A(t) exp(2 pi i n clock(t) / 2^32)], A(t) along its last transition, in full levels

Its angle is that of the amplifier's clock (`drivers.protocol.definition`), n its frequency word: it does
not depend on when it began. Amplitudes are complex, in full levels; times [s] are of any one clock.
Plain loops and few calls: every set is played by host and far end.
"""

import cmath
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import pairwise
from operator import attrgetter

from drivers.protocol.definition import QUANTITIES, SHORTENED_FADE
from drivers.protocol.sets import Command, Envelope

_PER_STEP = QUANTITIES["envelope_step"].per_unit
_PER_FULL, _PER_DEGREE = QUANTITIES["level"].per_unit, QUANTITIES["phase"].per_unit
_PER_HERTZ = QUANTITIES["frequency"].per_unit
_SILENCE = Command(channel=0, frequency=0, level=0, phase=0)
SAME = 1e-6
"""Ends of fades that are nearer than that are one, so that rounding decides nothing [s]."""


@lru_cache(maxsize=256)  # of a set's command asked for by its limits, its playback and its commit
def amplitude_of(level: int, phase: int) -> complex:
    """Return the complex amplitude in full levels of a level and phase of the wire."""
    return _amplitudes_at([(level, phase)])[0]


@lru_cache(maxsize=256)  # a set names an envelope several times, and its commit again
def amplitudes_of(envelope: Envelope | None) -> tuple[complex, ...]:
    """Return the complex amplitudes of the knots of an envelope in full levels, if there is one."""
    return () if envelope is None else _amplitudes_at(envelope.knots)


def _amplitudes_at(knots: Sequence[tuple[int, ...]]) -> tuple[complex, ...]:
    amplitudes = []
    for level, phase in knots:
        amplitudes.append(cmath.rect(level / _PER_FULL, math.radians(phase / _PER_DEGREE)))
    return tuple(amplitudes)


def peak_of(envelope: Envelope | None) -> float:
    """Return the largest magnitude of the knots of an envelope in full levels, 0 without one."""
    return 0.0 if envelope is None else envelope.peak / _PER_FULL


@dataclass(slots=True)  # frozen, each takes three times as long to make, and every set makes many
class Transition:
    """From one complex amplitude to another, from start [s] on until end.

    Along straight lines through knots a step [s] apart, or without knots along a raised cosine that
    lasts one step; a step of 0 changes at once. half [s], radius: by which its start and its first
    amplitude may differ, see `era_haptics.lab.expected_output`.
    """

    start: float
    step: float
    first: complex
    last: complex
    end: float
    knots: tuple[complex, ...] = ()
    half: float = 0.0
    radius: float = 0.0

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
        return max(self.points(since, until), key=abs)

    def points(self, since: float, until: float = math.inf) -> tuple[complex, ...]:
        """Return the amplitudes at two times [s] and at the knots between: others are between."""
        between = []
        for number, knot in enumerate(self.knots, 1):
            if since < self.start + self.step * number < until:
                between.append(knot)
        return (self.at(since), *between, self.at(until))

    def peak(self, time: float) -> float:
        """Return the largest magnitude from a time on."""
        if time <= self.start:  # nearly always: just committed
            return max(map(abs, (self.first, *self.knots, self.last)))
        return max(map(abs, self.points(time)))

    def slope(self, time: float) -> float:
        """Return the steepest change [full levels/s] from a time on; infinite for a jump."""
        if time >= self.end and (time > self.end or self.step):
            return 0.0
        points = (self.first, *self.knots, self.last)
        passed = int((time - self.start) / self.step) if self.knots else 0
        return steepest(pairwise(points[passed:]), self.step, is_cosine=not self.knots)[1]


def along(
    envelope: Envelope | None, time: float, ramp: float, first: complex, last: complex
) -> Transition:
    """Return a transition from a time [s] on: along an envelope, or a ramp [s] without one."""
    if envelope is None:
        return Transition(time, ramp, first, last, time + ramp)
    step = envelope.step / _PER_STEP
    end = time + step * (len(envelope.knots) + 1)
    return Transition(time, step, first, last, end, amplitudes_of(envelope))


def steepest(
    ways: Iterable[tuple[complex, complex]], step: float, *, is_cosine: bool
) -> tuple[float, float]:
    """Return the steepest rise of the magnitude, and the fastest change, of ways between points.

    Both in full levels a second; each way takes a step [s], on a straight line or a raised cosine.
    """
    rise = change = 0.0
    for one, other in ways:
        if one == other:
            continue
        fastest = abs(other - one) / step if step else math.inf
        change = max(change, fastest)
        # The way rises only where its end is farther out than the foot of the perpendicular.
        if ((other - one) * other.conjugate()).real > 0:
            rise = max(rise, fastest)
    factor = math.pi / 2 if is_cosine else 1.0
    return rise * factor, change * factor


@dataclass(frozen=True, slots=True)
class Voice:
    """A tone of a layer until it has faded: frequency [Hz], and when it began [s].

    has_ended: it falls silent and nothing continues it, unlike an onset that leads to level 0.
    ending: how it falls silent, None for the ramp.
    """

    layer: int
    frequency: float
    began: float
    transition: Transition
    has_ended: bool = False
    ending: Envelope | None = None

    @property
    def silent_from(self) -> float:
        """Time of silence [s]; infinite for a tone that lasts."""
        return math.inf if self.transition.last else self.transition.end

    def peak(self, time: float) -> float:
        """Return the largest magnitude from a time on, its ending included."""
        return max(self.transition.peak(time), peak_of(self.ending))

    def faded(self, time: float, ramp: float, uncertainty: float = 0.0) -> "Voice":
        """Return it falling silent along a ramp [s], or as it does if that is no later.

        uncertainty [s]: see `Playback`. Where it decides which of both is sooner, the largest
        amplitude of either lasts until both are over.
        """
        transition, end = self.transition, time + ramp
        if transition.last or transition.end > end + uncertainty + SAME:
            is_over = time - uncertainty >= transition.end
            first = transition.last if is_over else transition.reached(time, uncertainty)
            transition = Transition(time, ramp, first, 0j, end)
        elif uncertainty and transition.end > end - uncertainty:
            largest, over = transition.peak(time - uncertainty), max(transition.end, end)
            transition = Transition(over, 0.0, complex(largest), 0j, over)
        return Voice(self.layer, self.frequency, self.began, transition, True, self.ending)

    def ended(self, time: float, ramp: float, uncertainty: float = 0.0) -> "Voice":
        """Return it falling silent along its ending, or along a ramp [s] without one."""
        if self.ending is None or self.has_ended:
            return self.faded(time, ramp, uncertainty)
        first = self.transition.reached(time, uncertainty)
        return replace(self, transition=along(self.ending, time, ramp, first, 0j), has_ended=True)

    def scaled(self, time: float, factor: float, ramp: float) -> "Voice":
        """Return it led to a factor of its level along a ramp [s], its ending scaled too."""
        transition = self.transition
        last = transition.last * factor
        led = Transition(time, ramp, transition.at(time), last, time + ramp)
        ending = None if self.ending is None else self.ending.scaled(factor)
        return replace(self, transition=led, ending=ending)

    def corrected(self, command: Command | None) -> "Voice":
        """Return it leading to what a command says, None for silence, as far as it lasts."""
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
    """Return the voices of all channels once a layer plays commands by channel, else is silent."""
    all_after: list[tuple[Voice, ...]] = []
    for channel, voices in enumerate(channels):
        command = commands.get(channel, _SILENCE)
        # As `Command.is_driven`, without a call.
        is_driven = is_new = command.level > 0 or command.onset is not None
        last, frequency = amplitude_of(command.level, command.phase), command.frequency / _PER_HERTZ
        after: list[Voice] = []
        for voice in voices:
            if voice.layer != layer or voice.has_ended:
                after.append(voice)
            elif is_driven and command.keep_phase and voice.frequency == frequency:
                is_new = False
                first = voice.transition.reached(time, uncertainty)
                transition = along(command.onset, time, ramp, first, last)
                after.append(replace(voice, transition=transition, ending=command.ending))
            elif is_driven or command.skip_ending:
                after.append(voice.faded(time, ramp, uncertainty))
            else:
                after.append(voice.ended(time, ramp, uncertainty))
        if is_new:
            transition = Transition(time, ramp, 0j, last, time + ramp)
            if command.onset is not None:  # seldom: without a call
                transition = along(command.onset, time, ramp, 0j, last)
            after.append(Voice(layer, frequency, time, transition, False, command.ending))
        all_after.append(tuple(after))
    return all_after


def cut_to(voices: Sequence[Voice], time: float, max_voices: int, slew: float) -> list[Voice]:
    """Cut the oldest fades short where a channel has more voices than there are.

    slew: steepest change of a level that the amplifier has [full levels/s].
    """
    uncut = [voice for voice in voices if voice.silent_from > time + SHORTENED_FADE]
    fades = sorted(
        (voice for voice in uncut if voice.has_ended), key=attrgetter("transition.start")
    )
    cut = fades[: max(len(uncut) - max_voices, 0)]
    return [_cut_short(voice, time, slew) if voice in cut else voice for voice in voices]


def _cut_short(voice: Voice, time: float, slew: float) -> Voice:
    """Let a voice fall silent as soon as it can: a raised cosine is steepest at its middle."""
    steepest_fade = math.pi / 2 * abs(voice.transition.at(time)) / slew
    return voice.faded(time, max(SHORTENED_FADE, steepest_fade))
