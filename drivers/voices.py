"""Voices of one channel: the tones that it plays at once, in any layers, until they have faded.

    Voice: Im[A(t) exp(2 pi i f (t - origin))], A(t) along its last transition, in full levels

Times [s] are of any one clock. Plain loops and few calls: every set is played by host and far end.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from operator import attrgetter

from drivers.protocol.sets import Command, Envelope
from drivers.protocol.table import QUANTITIES, SHORTENED_FADE
from drivers.transition import Transition, along, amplitude_of, towards

_PER_HERTZ = QUANTITIES["frequency"].per_unit
_SAME = 1e-6  # s; ends nearer than that are one, so that rounding decides nothing


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
        """Return it falling silent along a ramp [s], or as it does if that is no later.

        uncertainty [s]: see `Playback`.
        """
        transition, end = self.transition, time + ramp
        if transition.last or transition.end > end + _SAME:
            is_over = time - uncertainty >= transition.end
            first = transition.last if is_over else transition.reached(time, uncertainty)
            transition = Transition(time, ramp, first, 0j, end)
        return Voice(self.layer, self.frequency, self.origin, transition, True, self.ending)

    def ended(self, time: float, ramp: float, uncertainty: float = 0.0) -> "Voice":
        """Return it falling silent along its ending, or along a ramp [s] without one."""
        if self.ending is None or self.has_ended:
            return self.faded(time, ramp, uncertainty)
        first = self.transition.reached(time, uncertainty)
        return replace(self, transition=along(self.ending, time, first, 0j), has_ended=True)

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

    def is_continued_by(self, command: Command) -> bool:
        """Whether a command of its layer continues it, unless it has ended."""
        is_same = self.frequency == command.frequency / _PER_HERTZ
        return command.keep_phase and is_same and command.is_driven


def voices_after(
    voices: Sequence[Voice],
    layer: int,
    command: Command | None,
    time: float,
    ramp: float,
    uncertainty: float,
) -> list[Voice]:
    """Return the voices of a channel once a command of a layer plays; None silences the layer."""
    is_driven = command is not None and command.is_driven
    is_fading = is_driven or (command is not None and command.skip_ending)
    is_new = is_driven
    after: list[Voice] = []
    for voice in voices:
        if voice.layer != layer or voice.has_ended:
            after.append(voice)
        elif command is not None and command.keep_phase and voice.is_continued_by(command):
            is_new = False
            first = voice.transition.reached(time, uncertainty)
            transition = towards(command, time, ramp, first)
            after.append(replace(voice, transition=transition, ending=command.ending))
        elif is_fading:
            after.append(voice.faded(time, ramp, uncertainty))
        else:
            after.append(voice.ended(time, ramp, uncertainty))
    if is_new and command is not None:
        if command.onset is None:  # nearly always
            last = amplitude_of(command.level, command.phase)
            transition = Transition(time, ramp, 0j, last, time + ramp)
        else:
            transition = towards(command, time, ramp, 0j)
        frequency = command.frequency / _PER_HERTZ
        after.append(Voice(layer, frequency, time, transition, False, command.ending))
    return after


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
