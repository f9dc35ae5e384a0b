"""What is asked of an amplifier: a drive command per channel, several of them as one set."""

from dataclasses import dataclass

from drivers.protocol.definition import PROTOCOL


@dataclass(frozen=True, slots=True)
class DriveCommand:
    """What one channel shall play, in electricity.

    frequency: mechanical frequency [Hz]; level: 0..1 of full stroke; phase [degrees] of
    level * sin(2 pi f t + phase), t counted from the commit for every channel of a set unless
    keep_phase asks that a channel which already plays this frequency runs on undisturbed in time.
    A channel with level 0 falls silent.
    """

    channel: int
    frequency: float
    level: float
    phase: float = 0.0
    keep_phase: bool = False


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


def token_after(token: int) -> int:
    """The token that follows one, or 0 for the first: 1..65535, then from 1 again."""
    return token % PROTOCOL.quantities.token.maximum + 1
