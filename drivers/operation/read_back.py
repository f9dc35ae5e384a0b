"""Comparison of commanded levels with those that an amplifier reports."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from drivers.command import DriveCommand

TOLERANCE = 0.01
"""Of full stroke: more than measuring errors, less than a derating or a lost set."""

MAX_MISMATCH_TIME = 0.100
"""Longest time [s] that levels may differ before it is a fault."""


@dataclass(frozen=True)
class Expectation:
    """Levels that an amplifier should report until the next set.

    settled_from [s]: end of ramps and envelopes; levels: by channel, 0 for channels not listed;
    differs_since [s]: first report that differed, None while they agree.
    """

    settled_from: float
    levels: Mapping[int, float]
    differs_since: float | None = None

    @classmethod
    def of(cls, commands: Sequence[DriveCommand], *, settled_from: float) -> "Expectation":
        """Derive the expectation from achieved commands."""
        levels = {command.channel: command.level for command in commands}
        return cls(settled_from, levels)


def read_back(expected: Expectation, levels: Sequence[float], now: float) -> Expectation:
    """Return the expectation after levels were reported at a time [s]."""
    if now < expected.settled_from or _agree(expected.levels, levels):
        since = None
    else:
        since = now if expected.differs_since is None else expected.differs_since
    return Expectation(expected.settled_from, expected.levels, since)


def is_fault(expected: Expectation, now: float) -> bool:
    """Whether levels have differed for too long at a time [s]."""
    return (
        expected.differs_since is not None
        and now - expected.differs_since >= MAX_MISMATCH_TIME - 1e-9
    )


def _agree(commanded: Mapping[int, float], reported: Sequence[float]) -> bool:
    return all(
        abs(level - commanded.get(channel, 0.0)) <= TOLERANCE
        for channel, level in enumerate(reported)
    )
