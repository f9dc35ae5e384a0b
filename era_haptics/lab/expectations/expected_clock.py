"""Expected clock of an amplifier."""

from typing import NamedTuple

from drivers.protocol.definition import HIGH_STEPS, MAX_AHEAD, ahead, high_word
from era_haptics.lab.expectations.mismatches import ReportMismatch
from era_haptics.lab.expectations.tolerances import CLOCK_DRIFT, Interval


class _Reading(NamedTuple):
    """A clock reading, and the interval in which it was taken."""

    clock: int
    when: Interval


class ExpectedClock:
    """Expected clock of an amplifier, first unknown; report: receives violations; slack [s]."""

    def __init__(self, report: ReportMismatch, slack: float) -> None:
        self._report = report
        self._slack = slack
        self._last_reading: _Reading | None = None
        self._marked: Interval | None = None
        self._is_unclear = False

    @property
    def present(self) -> int:
        """Return the high word read last, which is not in the future."""
        return 0 if self._last_reading is None else high_word(self._last_reading.clock)

    @property
    def is_marked(self) -> bool:
        """Return whether the next status shows the clock of a Mark."""
        return self._marked is not None

    def mark(self, when: Interval) -> None:
        """Record a Mark that arrives in an interval."""
        self._marked = when

    def shifted(self) -> None:
        """Record that the clock can continue from another value."""
        self._last_reading = None

    def unheard(self) -> None:
        """Record that the next status can show another clock than the last known request's.

        Either the current clock, if an earlier status showed the Mark, or a repeated Mark's clock.
        """
        self._is_unclear = True

    def check(self, clock: int, when: Interval) -> None:
        """Record the clock in a status, or compare it if it is the clock of a Mark."""
        marked = self._marked
        is_unclear = self._is_unclear
        self._marked = None
        self._is_unclear = False
        if is_unclear:
            return
        if marked is None:
            self._last_reading = _Reading(clock, when)
        elif self._last_reading is not None:
            self._check_mark(clock, marked, self._last_reading, when)

    def _check_mark(
        self, clock: int, marked: Interval, last_reading: _Reading, when: Interval
    ) -> None:
        """Compare the clock of a Mark with the last reading."""
        read = last_reading.when
        slack = self._slack + CLOCK_DRIFT * (marked.latest - read.earliest)
        low = marked.earliest - read.latest - slack
        high = marked.latest - read.earliest + slack
        elapsed = ahead(clock, last_reading.clock)
        if not low <= elapsed <= high:
            quantity = "time from the last clock reading to a Mark's reading"
            expected = f"{low} to {high} s"
            self._report("clock", when.latest, quantity, expected=expected, actual=elapsed)

    def moment(self, at: int, when: Interval) -> Interval | None:
        """Return when a set starts whose commit names a high word and arrives in an interval.

        None if it surely starts immediately.
        """
        if self._last_reading is None:
            return Interval(when.earliest, when.latest + MAX_AHEAD)
        read = self._last_reading.when
        remaining = ahead(at * HIGH_STEPS, self._last_reading.clock)
        drift = CLOCK_DRIFT * max(when.latest - read.earliest, remaining)
        early = read.earliest + remaining - drift
        late = read.latest + remaining + drift
        if early > when.latest and late <= when.earliest + MAX_AHEAD:
            return Interval(early, late)
        if late <= when.earliest or early > when.latest + MAX_AHEAD:
            return None
        return Interval(when.earliest, max(when.latest, late))
