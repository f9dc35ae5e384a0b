"""Drive commands of one amplifier: one per channel, together a command set; and envelopes.

    Pattern          model: an `Excitation` in Hz, metres and radians per ERA, with its measures
    CommandSet       routing turns an excitation into one `DriveCommand` per channel
    SafeCommandSet   a command set that a guard has checked; the only one that is encoded
    Achieved         the reply: the set as the amplifier quantises it

An envelope shapes the transition of a channel: its complex amplitude (level and phase) is linear
between knots a fixed step apart, starts at the present amplitude, and reaches that of the command
one step after the last knot. So the output is continuous.
"""

import cmath
import math
from dataclasses import dataclass
from typing import Self


@dataclass(frozen=True, slots=True)
class DriveCommand:
    """Tone of one channel, in electrical terms.

    frequency: mechanical frequency [Hz]; level: 0..1 of full stroke; phase [degrees] of
    level * sin(2 pi f t + phase), with t = 0 at the commit for every channel of a set, unless
    keep_phase continues the phase of a channel that already plays this frequency.
    A channel with level 0 falls silent.
    onset, ending: envelope slots, 0 for none; see `Envelope`. skip_ending: a channel that falls
    silent follows the ramp and not an earlier ending.
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
    """A point of an envelope: level 0..1 of full stroke, phase [degrees] as in a command."""

    level: float
    phase: float

    @classmethod
    def from_phasor(cls, phasor: complex) -> Self:
        """Make the knot of a complex amplitude in full strokes."""
        degrees = math.degrees(cmath.phase(phasor))
        return cls(abs(phasor), 180.0 if degrees == -180.0 else degrees)

    @property
    def phasor(self) -> complex:
        """Complex amplitude in full strokes, level exp(i phase)."""
        return cmath.rect(self.level, math.radians(self.phase))


@dataclass(frozen=True)
class Envelope:
    """A transition of a channel, stored by the amplifier in a slot, 1..63.

    step [s] between knots; no knots empty the slot. The final amplitude is not a knot: that of the
    command, or zero for an ending, follows one step after the last knot. An onset begins at the
    commit: at the present amplitude if the channel plays this frequency and keep_phase is set, else
    at zero. An ending leads to silence: when the next set silences the channel, or at the end of
    valid_for. Stop, disarm and faults skip endings. Staging a set copies its envelopes: a slot may
    be reloaded at any time.
    """

    slot: int
    step: float
    knots: tuple[Knot, ...]


@dataclass(frozen=True)
class CommandSet:
    """Drive commands of an amplifier that take effect together, all or nothing.

    token: 1..65535, identifies the set and is applied at most once; ramp [s]: each channel changes
    along a raised cosine; valid_for [s]: the vibration ends after this time (0: at the next set).
    Channels without a command are silent.
    """

    token: int
    commands: tuple[DriveCommand, ...]
    ramp: float
    valid_for: float

    @property
    def is_silent(self) -> bool:
        """Whether every level is zero."""
        return all(command.level == 0 for command in self.commands)
