"""Bounds of a channel's level during a cross-fade, from docs/reference/wire-protocol.md.

The old tone is scaled by (1 + cos(pi s)) / 2, the new one by (1 - cos(pi s)) / 2; they add with any
phase, so only bounds of the sum are known.
"""

import math
from typing import NamedTuple

UNKNOWN = (0.0, 1.0)
"""Bounds of an unknown level."""


class Fade(NamedTuple):
    """A fade that began within the interval `begin` [s]; before: bounds of the old level.

    The level is unknown until unknown_until [s].
    """

    begin: tuple[float, float] = (-math.inf, -math.inf)
    ramp: float = 0.0
    before: tuple[float, float] = (0.0, 0.0)
    after: float = 0.0
    unknown_until: float = -math.inf

    @property
    def settled_from(self) -> float:
        """Time at which the fade is over [s]."""
        return max(self.begin[1] + self.ramp, self.unknown_until)

    def at(self, time: float) -> tuple[float, float]:
        """Bounds of the level at a time [s]."""
        if time < self.unknown_until:
            return UNKNOWN
        early, late = (self._gain(time - begin) for begin in self.begin)
        low = max(0.0, *self._remainder(time))
        return low, self.before[1] * (1 - late) + self.after * early

    def within(self, begin: float, end: float) -> tuple[float, float]:
        """Bounds of the level over an interval [s]."""
        lows, highs = zip(self.at(begin), self.at(end), strict=True)
        # Old and new tone may cancel where their ratio crosses one.
        is_crossed = self._remainder(begin)[0] > 0 and self._remainder(end)[1] > 0
        return 0.0 if is_crossed else min(lows), max(highs)

    def _remainder(self, time: float) -> tuple[float, float]:
        """Least remainder of the old and of the new tone where they cancel."""
        early, late = (self._gain(time - begin) for begin in self.begin)
        return (
            self.before[0] * (1 - early) - self.after * early,
            self.after * late - self.before[1] * (1 - late),
        )

    def to(self, after: float, *, begin: tuple[float, float], ramp: float) -> "Fade":
        """The fade to another level.

        A tone that was fading out may end before this ramp does: of an interrupted fade only the
        upper bound is known.
        """
        low, high = self.within(*begin)
        return Fade(begin, ramp, (0.0 if begin[0] < self.settled_from else low, high), after)

    def _gain(self, elapsed: float) -> float:
        """Gain of the new tone."""
        if elapsed <= 0:
            return 1.0 if self.ramp == 0 and elapsed == 0 else 0.0
        if elapsed >= self.ramp:
            return 1.0
        return (1 - math.cos(math.pi * elapsed / self.ramp)) / 2
