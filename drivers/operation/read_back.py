"""Whether an amplifier plays what it was told: commanded levels against those it reports."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from drivers.command import DriveCommand

TOLERANCE = 0.01
"""Of full stroke: two amplifiers' ways of measuring a level, never a derating or a lost set."""

BORNE = 0.100
"""How long [s] levels may differ before that is a fault."""


@dataclass(frozen=True)
class Expectation:
    """What an amplifier should report from a time [s] on until it is told something else.

    settled_from [s]: before it there may be a fade; levels: by channel, 0 for those not named;
    differs_since [s]: when they were first seen to differ, None while they agree.
    """

    settled_from: float
    levels: Mapping[int, float]
    differs_since: float | None = None

    @classmethod
    def of(cls, commands: Sequence[DriveCommand], *, settled_from: float) -> "Expectation":
        """What follows from what was achieved."""
        levels = {command.channel: command.level for command in commands}
        return cls(settled_from, levels)


def read_back(expected: Expectation, levels: Sequence[float], now: float) -> Expectation:
    """The expectation after levels were reported at a time [s]."""
    if now < expected.settled_from or _agree(expected.levels, levels):
        since = None
    else:
        since = now if expected.differs_since is None else expected.differs_since
    return Expectation(expected.settled_from, expected.levels, since)


def is_fault(expected: Expectation, now: float) -> bool:
    """Whether commanded and reported levels have differed for too long at a time [s]."""
    return expected.differs_since is not None and now - expected.differs_since >= BORNE - 1e-9


def _agree(commanded: Mapping[int, float], reported: Sequence[float]) -> bool:
    return all(
        abs(level - commanded.get(channel, 0.0)) <= TOLERANCE
        for channel, level in enumerate(reported)
    )
