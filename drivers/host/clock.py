"""The clock of an amplifier as its host sees it, and how the host holds it to its own.

Each Status is a reading: between the last bit of its request and the first of its reply. Shift and
rate of the host are taken off before a line is laid below the readings (`clock_fit`), so that
steering feeds nothing back into what is measured, and no lost or late Ping makes it swing. The
shift goes with Arm, to the nearest step of 305 us; the rate with each Ping, which undoes the
crystal's and leads the rest to zero: soon while nothing plays, else within what is not felt. A
clock that cannot be steered or is not to be trusted has an infinite error, and stops nothing.
"""

import math

from drivers.host.clock_fit import ClockFit
from drivers.host.reports import CLOCK_SETTLING, MAX_CLOCK_RATE, ClockProblem
from drivers.protocol.clock import HIGH_TIME, HIGH_WORDS, ahead, clock_at
from drivers.protocol.records import Values
from drivers.protocol.table import CLOCK_TURN, CLOCK_UNKNOWN, ENABLED, QUANTITIES

_RATE, _ERROR = QUANTITIES["rate"], QUANTITIES["clock_error"]
_PLAYING = 0.5, 1e-4  # s to lead an error to zero, and by which rate at most: not felt
_SILENT = 0.25, 3e-3  # longer than a Ping is late; with a crystal's, within what a Ping can say
_COMMON = 0.1  # of an error, between clocks that were read by the same Marks
_SURELY = 4.0  # standard errors
_UNSETTLED = 20e-6, 5.0  # s, or errors of the estimate: what must be led to zero
_SLACK = 50e-6  # s; what is computed of bits and read of clocks, at the most


class HeldClock:
    """The clock of an amplifier, by its messages; times [s] are of the host's clock.

    stated: its `clock_error` as of the wire, known once it is identified.
    """

    def __init__(self) -> None:
        self.stated = CLOCK_UNKNOWN
        self.shortest = math.inf
        """Of its exchanges, the time beside the bits [s]: within it lies what no exchange shows."""
        self.is_alone = True
        """Whether it is held together with no other one."""
        self.takes_marks = False
        """Whether only readings of a Mark count, whose delay all on a line have in common."""
        self._rate = 0
        self._request = 0.0, 0.0  # when the last one was sent, and arrives at the soonest
        self._mark: tuple[float, float] | None = None
        self._pinged: float | None = None  # when the first Ping without reply arrives
        self._arming = 0  # the shift of an Arm without a reply
        self._is_armed = False
        self._jumped_at = -math.inf
        self._led_from = math.inf  # since when it is led to zero, and is not near
        self._forget(0.0)

    def _forget(self, time: float) -> None:
        """Begin anew at a time, as with a clock that was never read."""
        self._fit = ClockFit()
        self._added, self._added_at = 0.0, time  # s; by shifts and rates, until a time
        self._low, self._high, self._bounded_at = -math.inf, math.inf, time

    @property
    def can_be_steered(self) -> bool:
        """Whether it obeys shift and rate, as it states."""
        return self.stated != CLOCK_UNKNOWN

    def lead(self, time: float) -> float:
        """Return by how much it is ahead of the host's clock at a time [s], 0 before it is read."""
        if not self._fit:
            return 0.0
        lead = self._fit.lead(time) + self._added_until(time)
        return math.remainder(lead, CLOCK_TURN)

    def error(self, time: float, *, common: float | None = None) -> float:
        """Return its error [s rms] against the host's, with what it states; infinite if unknown.

        While armed with what is still to be led to zero. common: against those of others whose
        readings have the same errors, the lead [s] that all of them have.
        """
        if not (self.can_be_steered and self._fit) or self.problem(time) == "clock_jumped":
            return math.inf
        lead = self.lead(time) - (common or 0.0) if self._is_armed else 0.0
        stated = _ERROR.from_wire(self.stated) / math.sqrt(3)
        seen = self._fit.error(time) * (1.0 if common is None else _COMMON)
        return math.hypot(stated, seen, lead)

    def scatter(self, time: float) -> float:
        """Return the standard error of its readings [s]; infinite before the first."""
        return self._fit.error(time) if self._fit else math.inf

    def problem(self, time: float) -> ClockProblem | None:
        """Return what ails it at a time [s]; None if nothing."""
        if not self.can_be_steered:
            return None if self.is_alone else "clock_not_steered"
        if time - self._jumped_at < CLOCK_SETTLING:
            return "clock_jumped"
        if time - self._led_from > CLOCK_SETTLING:
            return "clock_unsettled"
        is_off = self._fit and abs(self._fit.rate) - _SURELY * self._fit.rate_error > MAX_CLOCK_RATE
        return "clock_rate" if is_off else None

    def shift(self, time: float) -> int:
        """Return the shift of an Arm that is sent at a time [s]."""
        if not self.can_be_steered:
            return 0
        return round(-self.lead(time) / HIGH_TIME) % HIGH_WORDS

    def rate(self, time: float, *, is_playing: bool) -> int:
        """Return the rate of a Ping that is sent at a time [s]."""
        if not (self.can_be_steered and self._fit) or self.problem(time) == "clock_jumped":
            return self._rate
        within, most = _PLAYING if is_playing else _SILENT
        crystal = min(max(self._fit.rate, -MAX_CLOCK_RATE), MAX_CLOCK_RATE)
        lead = self.lead(time)
        lead /= 1 + (self._fit.error(time) / max(abs(lead), 1e-9)) ** 2  # of what is seen well
        rate = min(max(-lead / within, -most), most) - crystal
        return round(rate * _RATE.per_unit)

    def sent(self, name: str, values: Values, now: float, arrives: float) -> None:
        """Note a request that is sent now and arrives at a time [s] at the soonest."""
        if name == "Mark":
            self._mark = now, arrives
            return
        self._request = now, arrives
        if name == "Arm":
            self._arming = values["shift"]
        elif name == "Ping" and self._pinged is None:
            self._pinged = arrives

    def replied(
        self, name: str, values: Values, status: Values, received: float, *, bits: float
    ) -> None:
        """Note a Status that replies to a request at a time [s]; bits [s]: its own time."""
        is_kept = self._mark is not None or not self.takes_marks
        sent, arrives = self._mark or self._request
        time = min(arrives, received)
        self._mark = None
        is_armed = status["state"] == ENABLED
        has_left = self._is_armed and not is_armed and name not in ("Stop", "Disarm")
        if name == "Arm" and is_armed:
            steps = (values["shift"] + HIGH_WORDS // 2) % HIGH_WORDS - HIGH_WORDS // 2
            self._added += steps * HIGH_TIME
        elif self._arming or has_left:  # whether it was shifted, or since when its rate is 0
            self._forget(time)
        self._arming = 0
        self.shortest = min(self.shortest, max(received - time - bits, 0.0))
        was_armed, self._is_armed = self._is_armed, is_armed
        # Whether a Ping without reply was heard is not known before that to the next one.
        is_kept &= self._pinged is None or name == "Ping"
        if is_kept or not self._fit:
            bounds = time - sent, received - time
            self._read(status["clock"], time, bounds, is_told=is_armed and was_armed)
        if name == "Ping" and is_armed:  # of several attempts any may have been the first heard
            self._run(values["rate"], ((self._pinged or arrives) + arrives) / 2)
        elif not is_armed:
            self._run(0, arrives)
        self._pinged = None
        self._watch(time)

    def _read(self, clock: int, time: float, bounds: tuple[float, float], *, is_told: bool) -> None:
        """Take a reading of a time, so much earlier [s] at the most, or so much later.

        is_told: whether a jump is said, since no restart explains it.
        """
        earlier, later = bounds
        added = self._added_until(time)
        expected = self._fit.lead(time) + added if self._fit else 0.0
        lead = expected + ahead(clock, clock_at(time + expected)) - added
        slack = _SLACK + (_ERROR.from_wire(self.stated) if self.can_be_steered else 0.0)
        drift = 2 * MAX_CLOCK_RATE * (time - self._bounded_at)
        lowest = max(self._low - drift, lead - later - slack)
        highest = min(self._high + drift, lead + earlier + slack)
        has_jumped = lowest > highest
        if has_jumped and is_told:
            self._jumped_at = time
        if has_jumped or self._fit.has_moved(time, lead):
            self._forget(time)
            lead = ahead(clock, clock_at(time))
            lowest, highest = lead - later - slack, lead + earlier + slack
        self._low, self._high, self._bounded_at = lowest, highest, time
        self._fit.add(time, lead, later)

    def _added_until(self, time: float) -> float:
        return self._added + self._rate / _RATE.per_unit * (time - self._added_at)

    def _run(self, rate: int, since: float) -> None:
        """Note that it runs by a rate since a time."""
        if rate != self._rate:
            self._added, self._added_at = self._added_until(since), since
            self._rate = rate

    def _watch(self, time: float) -> None:
        """Note since when it does not follow."""
        least, errors = _UNSETTLED
        if not self._is_armed or abs(self.lead(time)) <= max(least, errors * self.scatter(time)):
            self._led_from = math.inf
        else:
            self._led_from = min(self._led_from, time)
