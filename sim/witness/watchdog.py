"""When an amplifier's watchdog was fed and when it expires, as intervals."""

import math

from sim.witness.violation import ReportViolation

_LEFT = 0.011  # s; tolerance of the reported time left, as that of a host


class Watchdog:
    """The watchdog of an amplifier; time [s]: as set by Arm, infinite before.

    The time of the last feed is known only as an interval, from request to reply.
    """

    def __init__(self, name: str, *, slack: float, report: ReportViolation) -> None:
        self.time = math.inf
        self._name = name
        self._slack = slack
        self._report = report
        self._fed = (-math.inf, math.inf)
        self._latest_before = math.inf

    def __str__(self) -> str:
        """Its state, for messages."""
        return f"last fed at {self._fed[1]:.4f} s, watchdog {self.time:g} s"

    @property
    def expiry(self) -> tuple[float, float]:
        """Earliest and latest time of expiry [s]."""
        return self._fed[0] + self.time, self._fed[1] + self.time

    def forget(self) -> None:
        """Treat the time of the last feed as unknown."""
        self._fed = (-math.inf, math.inf)

    def feed(self, between: tuple[float, float]) -> None:
        """Feed it at some time between two [s]."""
        self._fed = between

    def may_feed(self, time: float) -> None:
        """Note a request that feeds it unless refused; `undo_feed` takes it back."""
        self._latest_before = self._fed[1]
        self._fed = (self._fed[0], max(self._fed[1], time))

    def undo_feed(self) -> None:
        """Note the refusal of the request given to `may_feed`."""
        self._fed = (self._fed[0], self._latest_before)

    def has_expired(self, time: float) -> bool:
        """Whether it must have expired."""
        return time > self.expiry[1] + self._slack

    def may_have_expired(self, time: float) -> bool:
        """Whether it may have expired."""
        return time > self.expiry[0] - self._slack

    def check_trip(self, time: float) -> None:
        """Check that it did not expire early."""
        if time < self.expiry[0] - self._slack:
            self._report(
                "watchdog",
                time,
                f"{self._name}: watchdog of {self.time:g} s expired "
                f"{time - self._fed[0]:.4f} s after its last feed",
            )

    def check_left(self, left: float, begin: float, end: float) -> None:
        """Check the reported time left [s], true at some time between two."""
        low = self.time - (end - self._fed[0]) - _LEFT - self._slack
        high = self.time - max(0.0, begin - self._fed[1]) + _LEFT + self._slack
        if self.time < math.inf and not low <= left <= high:
            self._report(
                "watchdog",
                end,
                f"{self._name}: watchdog_left must be {low:.3f} to {high:.3f} s, got {left:g} s "
                f"(set to {self.time:g} s, fed at {self._fed[0]:.4f} s)",
            )
