"""What is asked of an amplifier: a drive command per channel, several of them as one set.

An envelope shapes how a channel gets from what it plays to what it shall play: its complex
amplitude, level and phase, goes along straight lines from where it is through the knots, one every
step, and reaches what the command says one step after the last knot. So nothing can jump.
"""

import cmath
import math
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class DriveCommand:
    """What one channel shall play, in electricity.

    frequency: mechanical frequency [Hz]; level: 0..1 of full stroke; phase [degrees] of
    level * sin(2 pi f t + phase), t counted from the commit for every channel of a set unless
    keep_phase asks that a channel which already plays this frequency runs on undisturbed in time.
    A channel with level 0 falls silent.
    onset, ending: slots of envelopes, 0 for none; see `Envelope`. skip_ending: a channel that falls
    silent does so along the ramp, whatever ending it was given.
    """

    channel: int
    frequency: float
    level: float
    phase: float = 0.0
    keep_phase: bool = False
    onset: int = 0
    ending: int = 0
    skip_ending: bool = False

    @property
    def phasor(self) -> complex:
        """Complex amplitude in full strokes, level exp(i phase)."""
        return cmath.rect(self.level, math.radians(self.phase))


@dataclass(frozen=True, slots=True)
class Knot:
    """Where a channel is on its way: level 0..1 of full stroke, phase [degrees] as a command's."""

    level: float
    phase: float

    @property
    def phasor(self) -> complex:
        """Complex amplitude in full strokes, level exp(i phase)."""
        return cmath.rect(self.level, math.radians(self.phase))


@dataclass(frozen=True)
class Envelope:
    """How a channel gets to what it shall play, kept by the amplifier under a slot, 1..63.

    step [s] between knots; without knots the slot is empty again. As an onset it begins at the
    commit: from the present amplitude where the channel plays this frequency and keep_phase is
    set, else from zero. As an ending it leads to silence: when the next set makes the channel
    silent, or at the end of valid_for. Stop, disarm and faults know no endings. A set takes
    its envelopes with it when it is staged: a slot may be loaded anew at any time.
    """

    slot: int
    step: float
    knots: tuple[Knot, ...]


@dataclass(frozen=True)
class CommandSet:
    """Drive commands that take effect together, all or nothing.

    token: 1..65535, names the set, applied at most once; ramp [s]: each channel fades from what it
    plays to what it shall play along a raised cosine; valid_for [s]: the vibration ends by itself
    after this time (0: it lasts until the next set). Channels that are not named keep silent.
    """

    token: int
    commands: tuple[DriveCommand, ...]
    ramp: float
    valid_for: float

    @property
    def is_silent(self) -> bool:
        """Whether the set asks for no vibration at all."""
        return all(command.level == 0 for command in self.commands)
