"""Expected watchdog of an amplifier: when it was fed, and when it trips."""

import math

from era_haptics.lab.expectations.mismatches import ReportMismatch
from era_haptics.lab.expectations.tolerances import DRIFT, ROUNDED, UNKNOWN, Interval

_TRIP = 0.005  # s; from the end of the watchdog time until the watchdog trips


class ExpectedWatchdog:
    """Expected watchdog of an amplifier; report: receives violations; slack: of times [s]."""

    def __init__(self, report: ReportMismatch, slack: float) -> None:
        self.time = math.inf
        """Watchdog time of the last Arm [s], infinite while unknown."""
        self.fed = UNKNOWN
        """Interval in which the watchdog was fed last."""
        self._report = report
        self._slack = slack

    @property
    def expiry(self) -> Interval:
        """Return the earliest and latest time at which the watchdog trips if it is not fed."""
        if self.time == math.inf:
            return UNKNOWN
        min_time = self.time * (1 - DRIFT)
        max_time = (self.time + _TRIP) * (1 + DRIFT)
        return Interval(self.fed.earliest + min_time - ROUNDED, self.fed.latest + max_time)

    def must_have_tripped(self, now: float) -> bool:
        """Return whether the watchdog of an armed amplifier has surely tripped."""
        return now > self.expiry.latest + ROUNDED + self._slack

    def trip_interval(self, now: float, last_status: float) -> Interval:
        """Return the interval in which the watchdog tripped, if it tripped by now.

        last_status [s]: time of the last status before the trip.
        """
        early, late = self.expiry
        earliest = min(max(early, last_status), now)
        return Interval(earliest, max(min(late, now), earliest))

    def check_remaining(
        self, remaining: float, when: Interval, *, is_enabled: bool, cause: str
    ) -> None:
        """Compare the remaining time [s] in a status; disarmed: 0."""
        low = high = 0.0
        if is_enabled:
            if self.time == math.inf:
                return
            slack = ROUNDED + self._slack
            low = self.time - (when.latest - self.fed.earliest) - slack
            high = self.time - (when.earliest - self.fed.latest) + slack
        if not low <= remaining <= max(high, 0.0):
            expected = f"{low:.6g} to {high:.6g}"
            quantity = f"watchdog_left after {cause}"
            self._report("watchdog", when.latest, quantity, expected=expected, actual=remaining)

    def check_trip(self, enabled_until: float, when: Interval, *, cause: str) -> None:
        """Check that the watchdog did not trip early; enabled_until [s]: latest armed time."""
        early, late = self.expiry
        if enabled_until < early - self._slack:
            quantity = f"time of the watchdog ({cause})"
            expected = f"from {early:.4f} to {late:.4f} s"
            actual = f"{when.latest:.4f} s"
            self._report("watchdog", when.latest, quantity, expected=expected, actual=actual)
