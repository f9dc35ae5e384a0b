"""The clock of a simulated amplifier: what its samples count, as a function of the bench's time.

    Crystal: counts age + error * age + warm_up * tau * (age - tau * (1 - exp(-age / tau))) [s]
    Clock:   runs 1 + rate times as fast as its crystal, from each change of its rate on

Sums are whole numbers, so that nothing adds up over hours of steering.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

from drivers.protocol.definition import CLOCK_TURN, HIGH_STEPS, QUANTITIES, SPAN, clock_at

SETTLING = 10.0
"""Time constant [s] with which a crystal warms up: its error ends warm_up * SETTLING higher."""

_PER_RATE = QUANTITIES["rate"].per_unit
_PER_CRYSTAL = 1 << 40  # parts of a second of the crystal
_PER_SECOND = _PER_CRYSTAL * _PER_RATE  # parts of a second of the clock
_TURN = round(CLOCK_TURN) * _PER_SECOND
_STEPS = 4  # of Newton's method: each leaves the square of an error of 1e-4


@dataclass(frozen=True)
class Crystal:
    """A crystal, by default without errors.

    error: relative, by which it is fast at first; warm_up [1/s]: by which that grows at first, see
    `SETTLING`; ahead [s]: what the clock shows beyond the bench's time at first.
    """

    error: float = 0.0
    warm_up: float = 0.0
    ahead: float = 0.0

    def counted(self, age: float) -> float:
        """Return the seconds that it counts in its first seconds."""
        warming = age + SETTLING * math.expm1(-age / SETTLING)
        return age + self.error * age + self.warm_up * SETTLING * warming

    def pace(self, age: float) -> float:
        """Return the seconds that it counts in a second, at an age [s]."""
        return 1 + self.error - self.warm_up * SETTLING * math.expm1(-age / SETTLING)

    def drift(self, age: float) -> float:
        """Return by how much its pace grows in a second, at an age [s]."""
        return self.warm_up * math.exp(-age / SETTLING)


class StraightClock(NamedTuple):
    """A clock that runs straight on: what it shows [s] at a time [s], and its seconds a second."""

    time: float
    shown: float
    pace: float

    def at(self, time: float) -> float:
        """Return what it shows at a time [s], within a turn."""
        return (self.shown + (time - self.time) * self.pace) % CLOCK_TURN


class AmplifierClock:
    """A clock of 32 bits that goes round once in 20 s, with supply since a time [s].

    Times [s] are the bench's, not before the last change; rate: in units of the wire; changes:
    counts those of its rate, and those of what it shows.
    """

    def __init__(self, crystal: Crystal = Crystal(), *, since: float = 0.0) -> None:
        self.crystal = crystal
        self.rate = 0
        self.changes = 0
        self._since = since
        # Parts of a second that crystal and clock had counted when its rate changed last.
        self._crystal, self._clock = 0, round((since + crystal.ahead) * _PER_SECOND)

    def reading(self, time: float) -> int:
        """Return the clock as a Status shows it, at a time [s]."""
        return clock_at(self._parts(time) % _TURN / _PER_SECOND)

    def seconds(self, time: float) -> float:
        """Return the clock [s] at a time [s], where it does not go round."""
        return self._parts(time) / _PER_SECOND

    def straight(self, time: float) -> StraightClock:
        """Return it as it runs at a time [s], as if it went on so."""
        pace = self.crystal.pace(time - self._since) * (1 + self.rate / _PER_RATE)
        return StraightClock(time, self._parts(time) % _TURN / _PER_SECOND, pace)

    def steady(self, time: float, change: float) -> float:
        """Return for how long its crystal's drift changes it by less than a time [s]."""
        drift = abs(self.crystal.drift(time - self._since))
        return math.sqrt(2 * change / drift) if drift else math.inf

    def steer(self, rate: int, time: float) -> None:
        """Let it run faster than its crystal by a rate, from a time [s] on."""
        if rate != self.rate:
            self._clock, self._crystal = self._parts(time), self._counted(time)
            self.rate = rate
            self.changes += 1

    def shift(self, steps: int) -> None:
        """Move it on by steps of its high word."""
        self._clock += steps * HIGH_STEPS * _TURN // SPAN
        self.changes += 1

    def restart(self, time: float) -> None:
        """Let it show 0 at a time [s], as fast as its crystal, which stays as warm as it is."""
        self._clock, self._crystal, self.rate = 0, self._counted(time), 0
        self.changes += 1

    def reaches(self, high: int, time: float) -> float:
        """Return when its high word becomes this one next [s], as it runs at a time [s].

        That time itself, where it begins just there.
        """
        left = (high * HIGH_STEPS * _TURN // SPAN - self._parts(time)) % _TURN
        counted = self._counted(time) / _PER_CRYSTAL + left / (_PER_CRYSTAL * self._pace_words)
        age = time - self._since + left / _PER_SECOND
        for _ in range(_STEPS):
            age -= (self.crystal.counted(age) - counted) / self.crystal.pace(age)
        return max(self._since + age, time)

    @property
    def _pace_words(self) -> int:
        return _PER_RATE + self.rate

    def _counted(self, time: float) -> int:
        return round(self.crystal.counted(time - self._since) * _PER_CRYSTAL)

    def _parts(self, time: float) -> int:
        return self._clock + (self._counted(time) - self._crystal) * self._pace_words
