"""When an amplifier's watchdog was filled, and when it runs out, within bounds."""

import math

from sim.witness.decoded import ReportViolation

_LEFT = 0.003  # s; what its time left may be wrong by


class Watchdog:
    """The watchdog of an amplifier by its name; time [s]: as Arm has set it, none before.

    What fills it is seen before anybody knows whether and when it was taken: it was filled last
    between two times [s].
    """

    def __init__(self, name: str, *, slack: float, report: ReportViolation) -> None:
        self.time = math.inf
        self._name = name
        self._slack = slack
        self._report = report
        self._fed = (-math.inf, math.inf)
        self._latest_before = math.inf

    def __str__(self) -> str:
        """What it is, as the second half of a sentence."""
        return f"it was fed last at {self._fed[1]:.4f} s and its watchdog is set to {self.time:g} s"

    @property
    def runs_out(self) -> tuple[float, float]:
        """When it does so, at the earliest and at the latest [s]."""
        return self._fed[0] + self.time, self._fed[1] + self.time

    def forget(self) -> None:
        """Nobody knows when it was filled."""
        self._fed = (-math.inf, math.inf)

    def fed(self, between: tuple[float, float]) -> None:
        """It was filled between two times [s]."""
        self._fed = between

    def may_feed(self, time: float) -> None:
        """Something may have filled it; `was_not_fed` takes that back."""
        self._latest_before = self._fed[1]
        self._fed = (self._fed[0], max(self._fed[1], time))

    def undo_feed(self) -> None:
        """What may have filled it was refused."""
        self._fed = (self._fed[0], self._latest_before)

    def has_run_out(self, time: float) -> bool:
        """Whether it must have run out by now."""
        return time > self.runs_out[1] + self._slack

    def may_have_run_out(self, time: float) -> bool:
        """Whether it may have run out by now."""
        return time > self.runs_out[0] - self._slack

    def check_trip(self, time: float) -> None:
        """It has run out: not before its time."""
        if time < self.runs_out[0] - self._slack:
            self._report(
                "watchdog",
                time,
                f"{self._name}'s watchdog ran out {time - self._fed[0]:.4f} s after it was fed, "
                f"but it was set to {self.time:g} s",
            )

    def check_left(self, left: float, begin: float, end: float) -> None:
        """What it is said to have left [s], at some time between two."""
        low = self.time - (end - self._fed[0]) - _LEFT
        high = self.time - max(0.0, begin - self._fed[1]) + _LEFT
        if self.time < math.inf and not low <= left <= high:
            self._report(
                "watchdog",
                end,
                f"{self._name} says its watchdog has {left:g} s left; it must be {low:.3f} to "
                f"{high:.3f} s, for it was set to {self.time:g} s and fed at {self._fed[0]:.4f} s",
            )
