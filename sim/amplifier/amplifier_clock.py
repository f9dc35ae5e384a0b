"""Clock of a simulated amplifier: a crystal with errors, and a counter that the host steers.

    Crystal: counts age + error * age + warm_up * tau * (age - tau * (1 - exp(-age / tau))) [s]
    Clock:   runs 1 + rate times as fast as its crystal, from each change of its rate on

The clock sums whole numbers, so that no rounding adds up over hours of steering.
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
_NEWTON_STEPS = 4  # an error of 1e-4 is squared in each step


@dataclass(frozen=True)
class Crystal:
    """A crystal, by default without errors.

    error: initial relative rate error; warm_up: its initial growth [1/s], see `SETTLING`; ahead:
    initial lead of the clock over the bench's time [s].
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
        """Return the growth of its pace in a second, at an age [s]."""
        return self.warm_up * math.exp(-age / SETTLING)


class StraightClock(NamedTuple):
    """A clock with a constant rate: its value [s] at a time [s], and its rate."""

    time: float
    shown: float
    pace: float

    def at(self, time: float) -> float:
        """Return its value at a time [s], within a turn."""
        return (self.shown + (time - self.time) * self.pace) % CLOCK_TURN


class AmplifierClock:
    """A clock of 32 bits that wraps every 20 s, with supply since a time [s].

    Times [s] are the bench's, not before the last change; rate: in units of the wire; changes:
    counts changes of the rate, and changes of the shown value.
    """

    def __init__(self, crystal: Crystal = Crystal(), *, since: float = 0.0) -> None:
        self.crystal = crystal
        self.rate = 0
        self.changes = 0
        self._since = since
        # Parts of a second that the crystal and the clock had counted at the last change.
        self._crystal_parts = 0
        self._clock_parts = round((since + crystal.ahead) * _PER_SECOND)

    def reading(self, time: float) -> int:
        """Return the clock as a Status shows it, at a time [s]."""
        return clock_at(self._parts(time) % _TURN / _PER_SECOND)

    def seconds(self, time: float) -> float:
        """Return the clock [s] at a time [s], without wrapping."""
        return self._parts(time) / _PER_SECOND

    def straight(self, time: float) -> StraightClock:
        """Return the clock with its pace at a time [s], extrapolated without changes."""
        crystal_pace = self.crystal.pace(time - self._since)
        pace = crystal_pace * (1 + self.rate / _PER_RATE)
        value = self._parts(time) % _TURN / _PER_SECOND
        return StraightClock(time, value, pace)

    def steady(self, time: float, change: float) -> float:
        """Return the duration [s] in which its crystal's drift changes it by less than a time [s].

        Infinite without drift.
        """
        drift = abs(self.crystal.drift(time - self._since))
        return math.sqrt(2 * change / drift) if drift else math.inf

    def steer(self, rate: int, time: float) -> None:
        """Let it run faster than its crystal by a rate, from a time [s] on."""
        if rate != self.rate:
            self._clock_parts = self._parts(time)
            self._crystal_parts = self._counted(time)
            self.rate = rate
            self.changes += 1

    def shift(self, steps: int) -> None:
        """Move it on by steps of its high word."""
        self._clock_parts += _parts_of_steps(steps)
        self.changes += 1

    def restart(self, time: float) -> None:
        """Let it show 0 at a time [s], as fast as its crystal, which keeps its temperature."""
        self._clock_parts = 0
        self._crystal_parts = self._counted(time)
        self.rate = 0
        self.changes += 1

    def reaches(self, high: int, time: float) -> float:
        """Return the next time [s] at which its high word takes a value, at its rate at a time [s].

        This is the given time if the high word takes the value exactly then.
        """
        missing_parts = (_parts_of_steps(high) - self._parts(time)) % _TURN
        # The count of the crystal at that time, and by Newton's method the age at that count.
        count_now = self._counted(time) / _PER_CRYSTAL
        count = count_now + missing_parts / (_PER_CRYSTAL * self._parts_per_count)
        age = time - self._since + missing_parts / _PER_SECOND
        for _ in range(_NEWTON_STEPS):
            age -= (self.crystal.counted(age) - count) / self.crystal.pace(age)
        return max(self._since + age, time)

    @property
    def _parts_per_count(self) -> int:
        """Parts of the clock per part of the crystal."""
        return _PER_RATE + self.rate

    def _counted(self, time: float) -> int:
        """Parts of a second that the crystal has counted at a time [s]."""
        return round(self.crystal.counted(time - self._since) * _PER_CRYSTAL)

    def _parts(self, time: float) -> int:
        """Parts of a second that the clock has counted at a time [s]."""
        counted_since_change = self._counted(time) - self._crystal_parts
        return self._clock_parts + counted_since_change * self._parts_per_count


def _parts_of_steps(steps: int) -> int:
    """Parts of the clock in steps of its high word."""
    return steps * HIGH_STEPS * _TURN // SPAN
