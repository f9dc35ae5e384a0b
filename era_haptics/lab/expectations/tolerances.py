"""Intervals in which events happened, and tolerances of times."""

import math
from typing import NamedTuple

from drivers.protocol.definition import QUANTITIES


class Interval(NamedTuple):
    """Interval in which something happened [s]."""

    earliest: float
    latest: float

    @property
    def half_width(self) -> float:
        """Half the length of the interval [s]."""
        return (self.latest - self.earliest) / 2


UNKNOWN = Interval(-math.inf, math.inf)
"""Interval of an event whose time is unknown."""
ROUNDED = 0.002
"""Rounding of times in milliseconds [s]."""
LATE = 0.002
"""Longest delay of a set that plays immediately [s]."""
SAMPLE = 0.0001
"""Longest delay of a set with a start time [s]."""
DRIFT = 1e-3
"""Relative drift of the amplifier's clock."""
CLOCK_DRIFT = DRIFT + QUANTITIES["rate"].high
"""Drift of the clock, including the largest rate."""
