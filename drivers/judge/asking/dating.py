"""When an amplifier's clock was read: all its readings together date each of them.

    A reading that shows u seconds came between s and r, so it showed 0 between s - u and r - u

What is common to all these intervals is short, however late this machine was for some.
"""

from drivers.judge.asking.client import When
from drivers.judge.outputs import DRIFT
from drivers.protocol.clock import HIGH_STEPS, SPAN, ahead
from drivers.protocol.table import CLOCK_UNKNOWN, QUANTITIES

_LONG = 5.0  # s; without a reading, after which it may have gone round
_BESIDE = 0.001  # s; by which levels may be older than the clock beside them
_ERROR = QUANTITIES["clock_error"]


class Dating:
    """The clock of one amplifier by this machine's; times [s].

    pace: seconds of the clock in one of its crystal. error: by how much readings contradict each
    other beyond what the clock may drift, since that was set to 0.
    """

    def __init__(self) -> None:
        self.pace, self.error = 1.0, 0.0
        self.forget()

    def forget(self) -> None:
        """Begin anew with the next reading."""
        self._last: tuple[int, float] | None = None  # the clock, and until when it was read
        self._counted = self._low = self._high = 0.0

    def shift(self, steps: int) -> None:
        """Move the clock on by steps of its high word."""
        if self._last is not None:
            self._last = (self._last[0] + steps * HIGH_STEPS) % SPAN, self._last[1]

    def dated(self, clock: int, when: When, stated: int) -> When:
        """Return when a status was true that shows the clock and was read in an interval.

        stated: `clock_error` of the amplifier.
        """
        if stated == CLOCK_UNKNOWN:
            return when
        last, self._last = self._last, (clock, when.latest)
        if last is None or when.latest - last[1] > _LONG:
            self._counted, self._low, self._high = 0.0, *when
            return when
        passed, slack = ahead(clock, last[0]) / self.pace, _ERROR.from_wire(stated)
        drift = DRIFT * abs(passed)
        self._counted += passed
        low = max(self._low - drift, when.earliest - self._counted - slack)
        high = min(self._high + drift, when.latest - self._counted + slack)
        if low > high:
            self.error = max(self.error, low - high)
            self._counted, self._low, self._high = 0.0, *when
            return when
        self._low, self._high = low, high
        first, end = low + self._counted - _BESIDE, high + self._counted + _BESIDE
        return When(max(when.earliest, first), min(when.latest, end))
