"""When an amplifier's watchdog was fed and when it expires, as intervals."""

import math

_LEFT = 0.011  # s; tolerance of the reported time left, as that of a host


class Watchdog:
    """The watchdog of an amplifier; time [s]: as set by Arm, infinite before.

    fed: when it was last, known only as an interval from request to reply. slack [s]: tolerance.
    """

    def __init__(self, slack: float) -> None:
        self.time = math.inf
        self.fed = (-math.inf, math.inf)
        self._slack = slack
        self._latest_before = math.inf

    def __str__(self) -> str:
        """Its state, for messages."""
        return f"watchdog of {self.time:g} s fed at {self.fed[0]:.4f} to {self.fed[1]:.4f} s"

    @property
    def expiry(self) -> tuple[float, float]:
        """Earliest and latest time of expiry [s]."""
        return self.fed[0] + self.time, self.fed[1] + self.time

    def may_feed(self, time: float) -> None:
        """Note a request that feeds it unless refused; `undo_feed` takes it back."""
        self._latest_before = self.fed[1]
        self.fed = (self.fed[0], max(self.fed[1], time))

    def undo_feed(self) -> None:
        """Note the refusal of the request given to `may_feed`."""
        self.fed = (self.fed[0], self._latest_before)

    def has_expired(self, time: float) -> bool:
        """Whether it must have expired."""
        return time > self.expiry[1] + self._slack

    def may_have_expired(self, time: float) -> bool:
        """Whether it may have expired."""
        return time > self.expiry[0] - self._slack

    def left_problem(self, left: float, begin: float, end: float) -> str:
        """Describe what is wrong with a time left [s], true at some time between two; or ""."""
        low = self.time - (end - self.fed[0]) - _LEFT - self._slack
        high = self.time - max(0.0, begin - self.fed[1]) + _LEFT + self._slack
        if self.time == math.inf or low <= left <= high:
            return ""
        return f"watchdog_left must be {low:.3f} to {high:.3f} s, got {left:g} s: {self}"
