"""Between which levels a channel must be while it fades, from docs/reference/wire-protocol.md.

What it played is multiplied by (1 + cos(pi s)) / 2, what it shall play by (1 - cos(pi s)) / 2, and
both are added; tones add with any phase, so that a level is known within bounds only.
"""

import math
from typing import NamedTuple

UNKNOWN = (0.0, 1.0)
"""Bounds that say nothing."""


class Fade(NamedTuple):
    """A channel that began to fade within `begin` [s, s]; before, after: levels, within bounds.

    Until free_until [s] nothing is known but that a level is one.
    """

    begin: tuple[float, float] = (-math.inf, -math.inf)
    ramp: float = 0.0
    before: tuple[float, float] = (0.0, 0.0)
    after: float = 0.0
    unknown_until: float = -math.inf

    @property
    def settled_from(self) -> float:
        """When nothing fades any more [s]."""
        return max(self.begin[1] + self.ramp, self.unknown_until)

    def at(self, time: float) -> tuple[float, float]:
        """Lowest and highest level at a time [s]."""
        if time < self.unknown_until:
            return UNKNOWN
        early, late = (self._gain(time - begin) for begin in self.begin)
        low = max(0.0, *self._left(time))
        return low, self.before[1] * (1 - late) + self.after * early

    def within(self, begin: float, end: float) -> tuple[float, float]:
        """Lowest and highest level at some time of a span [s]."""
        lows, highs = zip(self.at(begin), self.at(end), strict=True)
        # Where the one outweighs the other first and then is outweighed, they may cancel between.
        is_crossed = self._left(begin)[0] > 0 and self._left(end)[1] > 0
        return 0.0 if is_crossed else min(lows), max(highs)

    def _left(self, time: float) -> tuple[float, float]:
        """What is left at least where they cancel: of what was played, of what shall be."""
        early, late = (self._gain(time - begin) for begin in self.begin)
        return (
            self.before[0] * (1 - early) - self.after * early,
            self.after * late - self.before[1] * (1 - late),
        )

    def to(self, after: float, *, begin: tuple[float, float], ramp: float) -> "Fade":
        """What follows where it is told to go to a level.

        What was fading out when it is told so may be gone before this ramp is over, and what added
        to it then stands alone: of a fade that is cut short only the highest level is known.
        """
        low, high = self.within(*begin)
        return Fade(begin, ramp, (0.0 if begin[0] < self.settled_from else low, high), after)

    def _gain(self, elapsed: float) -> float:
        """Share of what shall be played."""
        if elapsed <= 0:
            return 1.0 if self.ramp == 0 and elapsed == 0 else 0.0
        if elapsed >= self.ramp:
            return 1.0
        return (1 - math.cos(math.pi * elapsed / self.ramp)) / 2
