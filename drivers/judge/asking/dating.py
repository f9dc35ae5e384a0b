"""Times by an amplifier's own clock, however late this machine was.

A reading that shows u seconds came between s and r, so its clock is ahead of that of this machine
by u - r to u - s. What is common to all these intervals is short.
"""

from drivers.judge.asking.client import When
from drivers.protocol.definition import CLOCK_UNKNOWN, HIGH_STEPS, QUANTITIES, SPAN, ahead
from era_haptics.lab.expected_output import DRIFT

_LONG = 5.0  # s; without a reading, after which it may have gone round
_BESIDE = 0.0002  # s; by which levels may be older than the clock beside them
_ERROR = QUANTITIES["clock_error"]


class Dating:
    """Times [s] by the clock of one amplifier, which began near those of this machine.

    pace: seconds of the clock in one of its crystal. error: by how much readings contradict each
    other beyond what the clock may drift, since that was set to 0.
    """

    def __init__(self) -> None:
        self.pace, self.error = 1.0, 0.0
        self._last: tuple[int, float] | None = None  # the clock, and until when it was read
        self._time, self._ahead = 0.0, (0.0, 0.0)  # of the last reading; of this machine's

    def shift(self, steps: int) -> None:
        """Move the clock on by steps of its high word."""
        if self._last is not None:
            self._last = (self._last[0] + steps * HIGH_STEPS) % SPAN, self._last[1]

    def interval(self, when: When) -> When:
        """Return what is between two times of this machine, behind the last reading."""
        if self._last is None:
            return when
        drift = DRIFT * max(when.latest - self._last[1], 0.0)
        low, high = self._ahead
        return When(max(when.earliest + low - drift, self._time), when.latest + high + drift)

    def dated(self, clock: int, when: When, stated: int) -> When:
        """Return when a status was true that shows the clock and was read in an interval.

        stated: `clock_error` of the amplifier.
        """
        if stated == CLOCK_UNKNOWN:
            return when
        last, self._last = self._last, (clock, when.latest)
        if last is None or when.latest - last[1] > _LONG:
            self._time = sum(when) / 2
            self._ahead = self._time - when.latest, self._time - when.earliest
            return when
        passed, slack = ahead(clock, last[0]) / self.pace, _ERROR.from_wire(stated)
        drift = DRIFT * abs(passed)
        self._time += passed
        first, latest = self._time - when.latest - slack, self._time - when.earliest + slack
        low, high = max(self._ahead[0] - drift, first), min(self._ahead[1] + drift, latest)
        self.error = max(self.error, low - high)
        self._ahead = (low, high) if low <= high else (first, latest)
        return When(self._time - _BESIDE, self._time)
