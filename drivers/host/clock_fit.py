"""How far ahead a clock is, and how fast it runs: the line below its readings of the last seconds.

A request takes the time of its bits at least. USB frames, other traffic and operating systems add
to that and never take from it, so a reading less the soonest arrival of its request is the lead of
the clock or more: the lowest ones are right. The way back, with its latency timers and the waking
of this process, does not count. Of each quarter of a second the lowest reading is kept; the line is
the edge of their lower hull below their mean time (S. Moon, P. Skelly, D. Towsley: Estimation and
removal of clock skew from network delay measurements, INFOCOM 1999).
"""

import math
from collections import deque
from collections.abc import Sequence
from itertools import pairwise

WINDOW = 8.0
"""Seconds of readings that count: less is noisier, and over more a crystal that warms up bends."""
_BUCKET = 0.25  # s
_LIKELY_RATE = 50e-6  # of a crystal against the host's; a steeper slope needs to be seen well
_TOUCHED = 2  # readings that make the line
_NEAR = 5  # one in so many: those next to it, whose mean distance says how well it is known
_END = 1.1  # error where the line ends, in these distances: by simulation
_SLOPE = 2.5  # that of its slope, in these by its length
_LEAST = 1e-6  # s; of a reading, and of the time of this process
_BEND = 3e-7  # 1/s; by which a crystal's rate changes while it warms up, mostly
_FAR, _FAR_ERRORS = 100e-6, 10.0  # s, and errors
_MOVED, _MOVED_FOR = 40, 2.0  # readings, and s: delays come and go sooner
_FEW = 4  # readings below which the time of an exchange bounds the error


class ClockFit:
    """Lead [s] and rate of a clock against the host's, from readings at times [s] that grow."""

    def __init__(self) -> None:
        self._lowest: deque[tuple[float, float, float]] = deque()  # time, lead, uncertainty
        self._is_fitted = False
        self._rate = self._lead = self._end = 0.0
        self._rate_error = _LIKELY_RATE
        self._above, self._above_since = 0, 0.0  # readings far above the line, in a row

    def __bool__(self) -> bool:
        """Whether there is a reading."""
        return bool(self._lowest)

    @property
    def time(self) -> float:
        """That of the last reading kept [s]."""
        return self._lowest[-1][0]

    @property
    def rate(self) -> float:
        """By how much the clock is faster than the host's."""
        self._fit()
        return self._rate

    @property
    def rate_error(self) -> float:
        """Standard error of the rate."""
        self._fit()
        return self._rate_error

    def has_moved(self, time: float, lead: float) -> bool:
        """Whether a reading, or all for some time up to it, are too far from the line to be of it.

        Then the clock was moved by less than an exchange shows, or what delayed all readings has
        ended. Called once with each reading.
        """
        if not self:
            return False
        off, far = lead - self.lead(time), _FAR + _FAR_ERRORS * self.error(time)
        self._above, since = (self._above + 1, self._above_since) if off > far else (0, time)
        self._above_since = since
        return off < -far or (self._above > _MOVED and time - since > _MOVED_FOR)

    def add(self, time: float, lead: float, uncertainty: float) -> None:
        """Add a reading; uncertainty [s]: by which its request may have arrived later."""
        lowest = self._lowest
        if lowest and int(time / _BUCKET) == int(lowest[-1][0] / _BUCKET):
            before = lowest[-1]
            if lead - before[1] >= self._rate * (time - before[0]):
                return
            lowest.pop()
            uncertainty = min(uncertainty, before[2])
        lowest.append((time, lead, uncertainty))
        while lowest[0][0] < time - WINDOW:
            lowest.popleft()
        self._is_fitted = False

    def lead(self, time: float) -> float:
        """Return by how much the clock is ahead of the host's at a time [s]."""
        self._fit()
        return self._lead + self._rate * (time - self.time)

    def error(self, time: float) -> float:
        """Return the standard error of the lead at a time [s]."""
        self._fit()
        bend = _BEND / 8 * (self.time - self._lowest[0][0]) ** 2
        return math.hypot(self._end, bend, _LEAST) + self._rate_error * max(0.0, time - self.time)

    def _fit(self) -> None:
        if self._is_fitted:
            return
        self._is_fitted = True
        end, count = self.time, len(self._lowest)
        points = [(time - end, lead) for time, lead, _ in self._lowest]
        mean = sum([time for time, _ in points]) / count
        slope = _slope_below(points, mean)
        above = sorted([lead - slope * time for time, lead in points])
        near = above[_TOUCHED : _TOUCHED + max(_TOUCHED, count // _NEAR)] or above[-1:]
        self._end = _END * (sum(near) / len(near) - above[0])
        if count < _FEW:
            self._end = max(self._end, min([each[2] for each in self._lowest]) / math.sqrt(12))
        self._rate_error = _LIKELY_RATE
        if (span := -points[0][0]) > 0:
            seen = _SLOPE * (self._end + _LEAST) / span
            if count >= 2 * _FEW:
                self._rate_error = seen
            else:  # what is likely of crystals counts, too
                slope *= _LIKELY_RATE**2 / (_LIKELY_RATE**2 + seen**2)
        self._rate, self._lead = slope, min([lead - slope * time for time, lead in points])


def _slope_below(points: Sequence[tuple[float, float]], mean: float) -> float:
    """Return the slope of the line below points that is nearest at their mean time; times grow."""
    hull: list[tuple[float, float]] = []
    for time, lead in points:
        while len(hull) > 1:
            (first, low), (middle, high) = hull[-2], hull[-1]
            if (high - low) * (time - first) < (lead - low) * (middle - first):
                break
            hull.pop()
        hull.append((time, lead))
    for (first, low), (last, high) in pairwise(hull):
        if last >= mean:
            return (high - low) / (last - first)
    return 0.0
