"""The clocks of a bench's amplifiers as its plate has them: straight on, while that is true enough.

A plate is solved anew where the motion of a base changes, and a host changes the rate of a clock
with every Ping. So the plate goes on with a straight clock until that is wrong by `WRONG`.
"""

import math
from collections.abc import Mapping

from drivers.protocol.definition import CLOCK_TURN
from sim.amplifier.readings import AmplifierClock, StraightClock

WRONG = 0.5e-6
"""Most by which a clock of the plate is wrong [s]: 0.1 degrees of 500 Hz, when it is replaced."""

_SOON = 0.05  # s; of a clock that is wrong then: a rate that is no correction of the last
_ALIKE = 10e-6  # of a pace; rates that a host chooses by readings that are not exact
_DRIFT = 0.1e-6  # s; by which the warm-up of a crystal may change it unseen


class StraightClocks:
    """Straight clocks in place of those of amplifiers by name, which hold at a time [s]."""

    def __init__(self, clocks: Mapping[str, AmplifierClock], *, time: float) -> None:
        self._clocks = clocks
        self.straight = {name: clock.straight(time) for name, clock in clocks.items()}
        """Those that hold now, by name."""
        self._due = dict.fromkeys(clocks, time)
        self._changes = dict.fromkeys(clocks, 0)
        self.renew(time)

    @property
    def next_due(self) -> float:
        """When one of them has to be looked at [s]."""
        return min(self._due.values())

    def renew(self, time: float) -> list[str]:
        """Replace those that do not hold from a time [s] on; return their names."""
        renewed = []
        for name, clock in self._clocks.items():
            if time < self._due[name] and self._changes[name] == clock.changes:
                continue
            self._changes[name] = clock.changes
            now = clock.straight(time)
            lasts = _lasts(self.straight[name], now)
            if lasts < _SOON:
                self.straight[name] = _renewed(self.straight[name], now)
                lasts = _lasts(self.straight[name], now)
                renewed.append(name)
            self._due[name] = time + min(lasts / 2, clock.steady(time, _DRIFT))
        return renewed


def _lasts(known: StraightClock, now: StraightClock) -> float:
    """Return for how long [s] a clock is right enough, negative if it is wrong."""
    drift, left = abs(now.pace - known.pace), WRONG - abs(_behind(known, now))
    return left / drift if drift else math.copysign(math.inf, left)


def _renewed(known: StraightClock, now: StraightClock) -> StraightClock:
    """Return the clock of now, at its mean pace since another was right where that is alike."""
    mean = known.pace + _behind(known, now) / max(now.time - known.time, _SOON)
    return now._replace(pace=mean) if abs(mean - now.pace) < _ALIKE else now


def _behind(known: StraightClock, now: StraightClock) -> float:
    """Return by how much a clock is behind that of now [s]."""
    return math.remainder(now.shown - known.at(now.time), CLOCK_TURN)
