"""Conversion of this machine's times to times of an amplifier's own clock.

A reading that shows u seconds was taken between s and r, so the amplifier's clock leads this
machine's clock by u - r to u - s. The intersection of these intervals over all readings is short,
however late this machine was.
"""

from drivers.protocol.definition import CLOCK_UNKNOWN, HIGH_STEPS, QUANTITIES, SPAN, ahead
from era_haptics.lab.conformance.outcomes import ContractViolation
from era_haptics.lab.expectations.tolerances import DRIFT, Interval

_MAX_GAP = 5.0  # s without a reading, after which the clock can have wrapped
_LEVEL_AGE = 0.0002  # s; levels in a status can be older than its clock by this
_CLOCK_ERROR = QUANTITIES["clock_error"]


class Dating:
    """Convert times [s] to the clock of an amplifier, which starts near this machine's time."""

    def __init__(self) -> None:
        self.pace = 1.0
        """Seconds of the clock per second of its crystal."""
        self.error = 0.0
        """Largest contradiction between readings, beyond the allowed drift [s]."""
        self._clock: int | None = None  # the last reading
        self._read_by = 0.0  # s; end of its interval, by this machine
        self._time = 0.0  # s; of the last reading, by the amplifier's clock
        self._min_lead = 0.0  # s; of the amplifier's clock over this machine's
        self._max_lead = 0.0

    def shift(self, steps: int) -> None:
        """Advance the clock by steps of its high word."""
        if self._clock is not None:
            self._clock = (self._clock + steps * HIGH_STEPS) % SPAN

    def expect_steady(self, violation: type[ContractViolation] = ContractViolation) -> None:
        """Raise ContractViolation (or a subclass) if readings contradict each other."""
        if self.error > 0:
            quantity = "contradiction between readings of its clock"
            raise violation(quantity, expected="0 ms", actual=f"{1e3 * self.error:.3g} ms")

    def between(self, earliest: float, latest: float) -> Interval:
        """Return an interval; raises ContractViolation for an empty one."""
        if earliest > latest:
            self.expect_steady()
        return Interval(min(earliest, latest), latest)

    def interval(self, when: Interval) -> Interval:
        """Convert an interval of this machine after the last reading."""
        if self._clock is None:
            return when
        drift = DRIFT * max(when.latest - self._read_by, 0.0)
        earliest = max(when.earliest + self._min_lead - drift, self._time)
        return self.between(earliest, when.latest + self._max_lead + drift)

    def dated(self, clock: int, when: Interval, clock_error: int) -> Interval:
        """Return when a status with this clock, read in an interval of this machine, was true.

        clock_error: the amplifier's capability.
        """
        if clock_error == CLOCK_UNKNOWN:
            return when
        last_clock, last_read_by = self._clock, self._read_by
        self._clock, self._read_by = clock, when.latest
        if last_clock is None or when.latest - last_read_by > _MAX_GAP:
            self._time = (when.earliest + when.latest) / 2
            self._min_lead = self._time - when.latest
            self._max_lead = self._time - when.earliest
            return when
        self._advance(ahead(clock, last_clock) / self.pace, when, clock_error)
        return Interval(self._time - _LEVEL_AGE, self._time)

    def _advance(self, duration: float, when: Interval, clock_error: int) -> None:
        """Narrow the bounds of the lead by a reading that is `duration` [s] after the last one."""
        self._time += duration
        slack = _CLOCK_ERROR.from_wire(clock_error)
        min_lead = self._time - when.latest - slack
        max_lead = self._time - when.earliest + slack
        drift = DRIFT * abs(duration)
        low = max(self._min_lead - drift, min_lead)
        high = min(self._max_lead + drift, max_lead)
        self.error = max(self.error, low - high)
        is_consistent = low <= high
        self._min_lead = low if is_consistent else min_lead
        self._max_lead = high if is_consistent else max_lead
