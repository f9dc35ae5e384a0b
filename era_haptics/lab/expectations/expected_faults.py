"""Expected fault list of an amplifier."""

import math
from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

from drivers.protocol.definition import FAULTS, NO_CHANNEL, name_of
from drivers.protocol.records import Values
from era_haptics.lab.expectations.mismatches import ReportMismatch
from era_haptics.lab.expectations.tolerances import DRIFT, ROUNDED, Interval


class _ObservedFault(NamedTuple):
    """A fault, and the interval in which it occurred."""

    fault: int
    when: Interval


class ExpectedFaults:
    """The last two observed faults of an amplifier; slack: tolerance of times [s]."""

    def __init__(self, report: ReportMismatch, slack: float) -> None:
        self._report = report
        self._slack = slack
        self._observed: deque[_ObservedFault] = deque(maxlen=2)  # newest first

    def add(self, fault: int, when: Interval) -> None:
        """Record a fault that occurred in an interval."""
        self._observed.appendleft(_ObservedFault(fault, when))

    def correct(self, fault: int, when: Interval) -> None:
        """Replace the newest fault by the reported fault."""
        self._observed[0] = _ObservedFault(fault, when)

    def check(self, rows: Sequence[Values], when: Interval) -> None:
        """Check a fault list: newest first, all observed faults, with their ages."""
        ages = [row["age"] for row in rows]
        self._expect(when, "ages of faults", sorted(ages), ages)
        watchdog_rows = [row for row in rows if row["fault"] == FAULTS["WATCHDOG"]]
        wrong_channels = {row["channel"] for row in watchdog_rows} - {NO_CHANNEL}
        self._expect(when, "channels of watchdog faults", set(), wrong_channels)
        faults = [(row["fault"], row["age"] / 1000) for row in rows]
        older_faults = iter(faults)
        for observed in self._observed:
            min_age, max_age = self._age_of(observed, when)
            is_listed = any(
                fault == observed.fault and min_age <= age <= max_age for fault, age in older_faults
            )
            if not is_listed:
                name = name_of(FAULTS, observed.fault)
                expected = f"{name} of {min_age:.3f} to {max_age:.3f} s ago, in its turn"
                self._report(
                    "faults", when.latest, "listed faults", expected=expected, actual=faults
                )
                return

    def _age_of(self, observed: _ObservedFault, when: Interval) -> tuple[float, float]:
        """Return the smallest and the largest age of a fault [s] at some time in an interval."""
        drift = DRIFT * (when.latest - observed.when.earliest)
        slack = ROUNDED + self._slack + (drift if drift < math.inf else 0.0)
        min_age = when.earliest - observed.when.latest - slack
        max_age = when.latest - observed.when.earliest + slack
        return min_age, max_age

    def _expect(self, when: Interval, quantity: str, expected: object, actual: object) -> None:
        if expected != actual:
            self._report("faults", when.latest, quantity, expected=expected, actual=actual)
