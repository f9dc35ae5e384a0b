"""Straight approximations of amplifier clocks, for the motion of the plate.

The plate is solved again whenever the motion of a base changes, and a host changes the rate of an
amplifier's clock with every Ping. The plate therefore uses a straight clock for each amplifier
until it differs by `WRONG` from the amplifier's own clock.
"""

import math
from collections.abc import Mapping

from drivers.protocol.definition import CLOCK_TURN
from sim.amplifier.amplifier_clock import AmplifierClock, StraightClock

WRONG = 0.5e-6
"""Largest error of a clock of the plate [s], 0.1 degrees at 500 Hz; then it is replaced."""

_SOON = 0.05  # s; a clock wrong within this time has a new rate, not a corrected one
_ALIKE = 10e-6  # of a pace; tolerance of rates that a host derives from inexact readings
_DRIFT = 0.1e-6  # s; tolerance for the warm-up of a crystal


class StraightClocks:
    """Straight approximations of amplifier clocks by name, valid at a time [s]."""

    def __init__(self, clocks: Mapping[str, AmplifierClock], *, time: float) -> None:
        self._clocks = clocks
        self.straight = {name: clock.straight(time) for name, clock in clocks.items()}
        """Current approximations by name."""
        self._due = dict.fromkeys(clocks, time)  # time [s] of the next check
        self._changes = dict.fromkeys(clocks, 0)  # of each clock at its last check
        self.renew(time)

    @property
    def next_due(self) -> float:
        """Time [s] of the next check of a clock."""
        return min(self._due.values())

    def renew(self, time: float) -> list[str]:
        """Replace approximations that are no longer valid at a time [s]; return their names."""
        renewed = []
        for name, clock in self._clocks.items():
            if time < self._due[name] and self._changes[name] == clock.changes:
                continue
            self._changes[name] = clock.changes
            current = clock.straight(time)
            valid_for = _valid_for(self.straight[name], current)
            if valid_for < _SOON:
                self.straight[name] = _replacement(self.straight[name], current)
                valid_for = _valid_for(self.straight[name], current)
                renewed.append(name)
            self._due[name] = time + min(valid_for / 2, clock.steady(time, _DRIFT))
        return renewed


def _replacement(former: StraightClock, current: StraightClock) -> StraightClock:
    """Return the current clock, with the mean pace since the former one if it is similar."""
    elapsed = max(current.time - former.time, _SOON)
    mean_pace = former.pace + _lag(former, current) / elapsed
    if abs(mean_pace - current.pace) < _ALIKE:
        return current._replace(pace=mean_pace)
    return current


def _valid_for(straight: StraightClock, current: StraightClock) -> float:
    """Return how long [s] an approximation remains accurate, negative if it is wrong."""
    drift = abs(current.pace - straight.pace)
    margin = WRONG - abs(_lag(straight, current))
    return margin / drift if drift else math.copysign(math.inf, margin)


def _lag(straight: StraightClock, current: StraightClock) -> float:
    """Return the lag of an approximation behind the current clock [s]."""
    return math.remainder(current.shown - straight.at(current.time), CLOCK_TURN)
