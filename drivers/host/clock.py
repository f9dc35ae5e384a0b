"""The clock of one amplifier: how the host reads and steers it, and what its statuses report.

A Status reads the clock between the last bit of its request and the first of its reply. USB frames,
other traffic and operating systems add to the time of the bits and never take from it, so a reading
less the soonest arrival of its request is at least the lead of the clock, and the lowest readings
are nearly right. The way back, with its latency timers, does not count. Of each part of the time
that was read, at most a quarter of a second, the lowest reading is kept, and a line is fitted by
least squares to the lower half of these: the lowest alone are best where frames add to the time,
their mean where the operating system does. Readings above the line show how late they may be. Shift
and rate of the host are taken off before, so that steering does not feed back into the measurement.

The shift goes with Arm, to the nearest step of 305 us. The rate goes with each Ping: it cancels the
crystal's and leads the rest to zero, fast while nothing plays, else too slowly to be felt. A clock
that cannot be steered or trusted has an infinite error, and stops nothing.

A Mark lets all clocks of a line keep the same byte, whatever delays it, so their differences are
known as exactly as they state them. One clock is held to the host's, the others to that one.
"""

import math
from collections import deque
from collections.abc import Sequence
from statistics import median_low
from typing import Literal, NamedTuple

from drivers.protocol.definition import (
    CLOCK_TURN,
    CLOCK_UNKNOWN,
    ENABLED,
    FAULTS,
    HIGH_TIME,
    HIGH_WORDS,
    QUANTITIES,
    SPAN,
    STATUS_FLAGS,
    ahead,
    name_of,
)
from drivers.protocol.records import Values

_HOT = 70.0  # °C, above which it is said; one that must not go on reports a fault
REPORT_LIFE = 10.0
"""For how long [s] a report is shown after the last status that had it."""
_PER_DEGREE = QUANTITIES["temperature"].per_unit
_LIMITED, _OPEN = 1 << STATUS_FLAGS["limited"], 1 << STATUS_FLAGS["interlock_open"]
_HIGH_VOLTAGE = 1 << STATUS_FLAGS["high_voltage"]

CLOCK_SETTLING = 3.0
"""Seconds within which a clock must follow, and for which one that has jumped is not trusted."""
MAX_CLOCK_RATE = 2e-4
"""Of a crystal against the host's; one that is faster or slower is broken."""

ClockProblem = Literal["clock_not_steered", "clock_jumped", "clock_rate", "clock_unsettled"]
ReportKind = Literal["limited", "interlock_open", "hot", ClockProblem]

REPORTS: dict[ReportKind, tuple[str, str]] = {
    "limited": (
        "a channel is cut off at full level: less is played than commanded",
        "lower the levels, and check full level and capabilities of this amplifier",
    ),
    "interlock_open": ("its interlock is open", "close the interlock; it does not arm before"),
    "hot": (
        f"it is hotter than {_HOT:g} °C",
        "let it cool, and check its fan and its load; it may play less, or stop with a fault",
    ),
    "clock_not_steered": (
        "its clock cannot be steered: its ERAs are not held together with those of others",
        "update its firmware, or exchange it",
    ),
    "clock_jumped": (
        "its clock jumps, stands still, has a wrong rate, or is read wrong by more than it states",
        "check its clock and clock_error: era amp conformance; beside others less is promised",
    ),
    "clock_rate": (
        f"its clock is more than {MAX_CLOCK_RATE * 1e6:g} ppm too fast or too slow",
        "check its crystal, and what its clock counts; less is promised meanwhile",
    ),
    "clock_unsettled": (
        f"its clock does not follow the host's within {CLOCK_SETTLING:g} s",
        "check that it obeys shift and rate: era amp conformance; less is promised meanwhile",
    ),
}
"""Cause and remedy of what a status shows that is no fault, by kind."""


def reports_of(status: Values, of_clock: ClockProblem | None = None) -> Sequence[ReportKind]:
    """Return the kinds of reports of a status; few calls, since every heartbeat has one.

    of_clock: what is known of its clock by now.
    """
    kinds: list[ReportKind] = [] if of_clock is None else [of_clock]
    if status["flags"] & _LIMITED:
        kinds.append("limited")
    if status["flags"] & _OPEN:
        kinds.append("interlock_open")
    if status["temperature"] > _HOT * _PER_DEGREE:
        kinds.append("hot")
    return kinds


def armed_problem(status: Values, latch: int | None) -> str | None:
    """Describe what no armed amplifier may report; None if nothing.

    latch: that of the reply to Arm, None before: a stop or fault since would have disarmed it.
    """
    if not status["flags"] & _HIGH_VOLTAGE:
        return "high voltage must be on, got off"
    if status["flags"] & _OPEN:
        return "interlock must be closed while armed, got open"
    if status["fault"]:
        return f"fault must be NONE while armed, got {name_of(FAULTS, status['fault'])}"
    if latch not in (None, status["latch"]):
        return f"latch must be {latch} since it was armed, got {status['latch']}"
    return None


WINDOW = 8.0
"""Readings count for so long [s]: fewer are noisier, and over longer a warming crystal bends."""
_PARTS, _MIN_PART = 32, 2.0**-8
"""Parts of that time, of each of which the lowest reading is kept; shortest length of one [s]."""
_MARKED = 1.0
"""Marks count for so long [s] where clocks are compared: over more a crystal bends."""
_AGREEING = 3
"""Fewest Marks by which clocks are compared: of two that differ, either may be false."""
_ROUNDS = 3
"""How often a line is fitted and the readings that it goes through are chosen anew."""
_RECENT = 8
"""Latest readings. The line may be wrong by as much as all of these lie above it; where they lie
far above it, the clock was moved."""
_BULK, _FAR_OUT = 64, 2.0
"""Latest readings of any height. Without the highest and lowest eighth of them they span a height;
readings that lie further below them than so many times that height are few and doubtful."""
_ERRORS = 1.4
"""Factor of a standard error, from a simulation: the lowest of several readings are correlated."""
_EXPECTED_RATE = 50e-6
"""Expected rate of a crystal against the host's; a greater one must be measured well."""
_MAX_CRYSTAL = 0.01
"""Rate that no oscillator has: beyond it a clock stands still, or runs backwards."""
_EXPECTED_BEND = 2e-7
"""Half of the expected change of a crystal's rate [1/s] while it warms up."""
_LEAST = 5e-7
"""Least error [s] of a reading, and of the time that this process reads."""
_FAR, _FAR_ERRORS = 100e-6, 10.0
"""A reading that is further off, in seconds plus standard errors, shows a clock that was moved."""
_TOO_FAST = 1e-3
"""What a clock may gain [s] beside its crystal, since readings are a little wrong."""
_GENTLE = 0.5, 1e-4
"""Time [s] in which an error is led to zero, and the highest rate for it, which is not felt."""
_FAST = 0.2, 2.8e-3
"""The same while nothing plays: four Pings, since lost ones would overshoot; a Ping's highest."""
_TOGETHER = 0.5, 5e-4
"""The same of all clocks of a line, whose Pings go one after another: faster they would part."""
_NEAR = 20e-6
"""A clock is led to zero where it is within so much [s], or within its error."""
_SURELY = 4.0
"""Standard errors beyond which a difference is no chance."""
_STEP = CLOCK_TURN / SPAN
"""Step [s] of a clock on the wire."""
_PER_RATE, _PER_ERROR = QUANTITIES["rate"].per_unit, QUANTITIES["clock_error"].per_unit


class _Line(NamedTuple):
    """Lead [s] at a time [s] and rate of a clock that is not steered; their standard errors."""

    time: float
    lead: float = 0.0
    rate: float = 0.0
    bend: float = 0.0
    error: float = math.inf
    rate_error: float = _EXPECTED_RATE

    def at(self, time: float) -> "_Line":
        """Return it at another time [s]."""
        later = time - self.time
        error = self.error + self.rate_error * max(0.0, later)
        return _Line(time, self.lead + self.rate * later, self.rate, 0.0, error, self.rate_error)


class HeldClock:
    """The clock of an amplifier, by its messages; times [s] are of the host's clock."""

    def __init__(self) -> None:
        self._has_bits = True  # no network, and no USB: they take their time
        self.identified(CLOCK_UNKNOWN, bits=0.0)
        self._promptest = math.inf  # exchange, less its bits [s]
        self.is_alone = True
        """Whether it is held together with no other one: then nothing is read of it."""
        self._other: HeldClock | None = None  # to which it is held, see `compare`
        self._is_first = False  # whether others are held to it
        self._pace = 0.0  # seconds a second, by the rate of a Ping
        self._requested = 0.0, 0.0  # when what a Status shows was sent, and arrives at the soonest
        self._shown = 0, -math.inf, 0.0  # a clock of one alone, and between which times
        self._marks = 0  # since a Status, which may show any of them
        self._pinged: tuple[float, float] | None = None  # when Pings without reply arrive
        self._arming = 0  # the shift of an Arm without a reply
        self._is_armed = False
        self._jumped_at = -math.inf
        self._near_at = 0.0  # when it was led to zero last
        self._forget(0.0)

    def _forget(self, time: float) -> None:
        """Begin anew at a time, as with a clock that was never read."""
        self._lowest: list[tuple[float, float, float]] = []  # time, lead, and how late at the most
        self._all = deque[tuple[float, float]](maxlen=_BULK)  # times and leads
        self._line = _Line(time)
        self._marked: dict[float, float] = {}  # leads, by when a Mark arrived
        self._beside = _Line(-math.inf)  # to the other's, from the newest Mark of both
        self._added = -self._pace * time  # s; with pace * time what shifts and rates have added
        self._is_doubted = False  # whether the last reading was too early, as none before

    def identified(self, stated: int, *, bits: float) -> None:
        """Note its `clock_error` as of the wire, and how long the bits of its Status take [s]."""
        self.stated, self.can_be_steered = stated, stated != CLOCK_UNKNOWN
        self._bits = bits if self._has_bits else 0.0

    @property
    def shortest(self) -> float:
        """Its promptest exchange beside the bits [s]: within it lies what no exchange shows."""
        return max(self._promptest, 0.0)

    @property
    def is_compared(self) -> bool:
        """Whether it is known by Marks how it differs from the clock to which it is held."""
        return self._first is not None

    @property
    def _first(self) -> "HeldClock | None":
        """The clock to which it is held, if it is compared with it."""
        other = self._other
        return other if other is not None and self._beside.time in other._marked else None

    def compare(self, other: "HeldClock | None") -> None:
        """Hold it to another clock of its line, by Marks that both have shown.

        None: to the host's. What delays a Mark is the same for all, so that nothing of it is in
        their difference.
        """
        if other is not self._other:
            self._other, self._beside = other, _Line(-math.inf)
        self._is_first = other is None

    def _seen(self, time: float) -> _Line:
        """Return its line at a time [s]."""
        if (first := self._first) is None:
            return self._line.at(time)
        line, beside = first._line.at(time), self._beside.at(time)
        error, rate_error = line.error + beside.error, line.rate_error + beside.rate_error
        return _Line(time, line.lead + beside.lead, line.rate + beside.rate, 0.0, error, rate_error)

    def lead(self, time: float) -> float:
        """Return by how much it is ahead of the host's clock at a time [s], 0 before it is read."""
        unsteered = self._seen(time).lead
        return math.remainder(unsteered + self._added + self._pace * time, CLOCK_TURN)

    def scatter(self, time: float) -> float:
        """Return the standard error of its lead as it is read [s]; infinite if it must be."""
        return math.inf if self._is_doubted else self._seen(time).error

    def error(self, time: float, *, off: float | None = None, is_common: bool = False) -> float:
        """Return its error [s rms] with what it states; infinite if unknown.

        off: by how much it is ahead of others [s], None: of the host's; counts while armed, as it
        is led to zero. is_common: against others of its line that are held to the same clock.
        """
        if not self.can_be_steered or self.problem(time) in ("clock_jumped", "clock_unsettled"):
            return math.inf
        lead = (self.lead(time) if off is None else off) if self._is_armed else 0.0
        seen = self._seen(time).error
        if is_common:
            seen = self._beside.at(time).error if self.is_compared else 0.0
        return math.hypot(self.stated / _PER_ERROR / math.sqrt(3), seen, lead)

    def problem(self, time: float) -> ClockProblem | None:
        """Return what ails it at a time [s]; None if nothing."""
        has_jumped = time - self._jumped_at < CLOCK_SETTLING
        if self.is_alone:
            return "clock_jumped" if has_jumped else None
        if not self.can_be_steered:
            return "clock_not_steered"
        if has_jumped:
            return "clock_jumped"
        if self._is_armed and time - self._near_at > CLOCK_SETTLING:
            return "clock_unsettled"
        rate = abs(self._line.rate)
        is_off = rate - _SURELY * self._line.rate_error > MAX_CLOCK_RATE
        if not is_off or len(self._lowest) <= _PARTS // 2:
            return None
        return "clock_rate" if rate < _MAX_CRYSTAL else "clock_jumped"

    def shift(self, time: float) -> int:
        """Return the shift of an Arm that is sent at a time [s]."""
        return round(-self.lead(time) / HIGH_TIME) % HIGH_WORDS if self.can_be_steered else 0

    def rate(self, time: float, *, is_playing: bool) -> int:
        """Return the rate of a Ping that is sent at a time [s]."""
        if not self.can_be_steered:
            return 0
        is_trusted = time - self._jumped_at >= CLOCK_SETTLING
        lead, line = self.lead(time) if is_trusted else 0.0, self._seen(time)
        first, common = self._first, 0.0
        if is_trusted and (first is not None or self._is_first):
            common = lead if first is None else first.lead(time)
        own, seen = lead - common, self._line if first is None else self._beside
        near = max(_NEAR, 2 * line.error)  # what is not seen accuses none
        if abs(own) <= near and (first or abs(common) <= max(near, _TOGETHER[1] * CLOCK_SETTLING)):
            self._near_at = time
        is_gentle = is_playing or abs(own) <= max(_NEAR, seen.error)
        led = 0.0
        for off, (within, highest) in ((common, _TOGETHER), (own, _GENTLE if is_gentle else _FAST)):
            led -= min(max(off / within, -highest), highest)
        led = min(max(led, -_FAST[1]), _FAST[1])
        crystal = min(max(line.rate, -MAX_CLOCK_RATE), MAX_CLOCK_RATE)
        return round((led - crystal) * _PER_RATE)

    def sent(self, name: str, values: Values, now: float, arrives: float) -> None:
        """Note a request that is sent now and arrives at a time [s] at the soonest."""
        arrives = arrives if self._has_bits else now
        if name == "Mark":
            self._marks += 1
        if name == "Mark" or not self._marks:
            self._requested = now, arrives
        if self.is_alone:
            return
        if name == "Arm":
            self._arming = values["shift"]
        elif name == "Ping":
            self._pinged = (self._pinged[0] if self._pinged else arrives), arrives

    def replied(self, name: str, values: Values, status: Values, received: float) -> None:
        """Note a Status that replies to a request at a time [s]."""
        (sent, arrives), marks, self._marks = self._requested, self._marks, 0
        was_armed, self._is_armed = self._is_armed, status["state"] == ENABLED
        if self.is_alone:
            is_reported = was_armed and self._is_armed and name != "Arm" and not marks
            self._check_pace(status["clock"], sent, received, is_reported=is_reported)
            return
        # Those of a reply may be fewer than stated, as CAN stuffs less; those of a request are not.
        if self._has_bits and received < arrives:
            self._has_bits, self._bits, self._promptest, arrives = False, 0.0, math.inf, sent
            self._forget(sent)
        time = min(arrives, received)
        if time - self._beside.time > _MARKED:  # what it differs by is no longer seen
            self._beside = _Line(-math.inf)
        has_left = was_armed and not self._is_armed and name not in ("Stop", "Disarm")
        if name == "Arm" and self._is_armed:
            self._added += values["shift"] * HIGH_TIME
            self._near_at = time
        elif self._arming or has_left:  # whether it was shifted, or since when its rate is 0
            self._forget(time)
        self._arming = 0
        self._promptest = min(self._promptest, received - time - self._bits)
        # Whether a Ping without reply was heard is not known before that to the next one.
        is_kept = self._pinged is None or name == "Ping"
        if marks <= 1 and (is_kept or not self._lowest):
            is_reported = was_armed and self._is_armed
            # A reply that is here before its request can be: the bits take less than they should.
            late = abs(received - arrives)
            lead = self._read(status["clock"], time, time - sent, late, is_reported=is_reported)
            if is_kept and marks:
                self._compare(time, lead)
            if not is_kept:  # until the first that counts
                self._lowest.clear()
        if name == "Ping" or not self._is_armed:
            pace = values["rate"] / _PER_RATE if self._is_armed else 0.0
            since = sum(self._pinged or (time, time)) / 2  # any attempt may be the first heard
            self._added += (self._pace - pace) * since
            self._pace, self._pinged = pace, None

    def _check_pace(self, clock: int, sent: float, received: float, *, is_reported: bool) -> None:
        """Compare what has passed on a clock that is alone with the host's, of some seconds."""
        shown, earliest, latest = self._shown
        if is_reported and received - earliest < CLOCK_SETTLING:
            passed = ahead(clock, shown)
            off = _FAR + _MAX_CRYSTAL * (received - earliest)
            if sent - latest - off <= passed <= received - earliest + off:
                return
            self._jumped_at = received
        self._shown = clock, sent, received

    def _read(
        self, clock: int, time: float, earlier: float, later: float, *, is_reported: bool
    ) -> float:
        """Take a reading of a time, so much earlier [s] at the most, or so much later.

        Returns its lead if it was not steered [s].

        is_reported: whether a jump is said, since no restart explains it.
        """
        line, shown = self._line, clock * _STEP - time - self._added - self._pace * time
        lead = line.lead + line.rate * (time - line.time)
        off = math.remainder(shown - lead, CLOCK_TURN)
        error = self._seen(time).error
        far = _FAR + _FAR_ERRORS * error + self.stated / _PER_ERROR
        # What was read before came late where it is above, each by no more than its exchange took.
        sure = max(
            [low - late - line.rate * (at - time) for at, low, late in self._lowest],
            default=-math.inf,
        )
        # And early nowhere: what is above by more than any crystal gains runs too fast.
        highest = min(
            [low + _MAX_CRYSTAL * (time - at) for at, low, _ in self._lowest], default=math.inf
        )
        is_early = off < sure - lead - far - earlier
        self._is_doubted = is_early and not self._is_doubted
        if self._is_doubted:  # one alone may show a Mark that came twice
            return lead + off
        if is_early or off > later + far or off > later + highest - lead + _TOO_FAST:
            if is_reported:
                self._jumped_at = time
            self._forget(time)
            lead, off = 0.0, math.remainder(clock * _STEP - time, CLOCK_TURN)
        elif off < -_FAR - _SURELY * error:
            for number, (at, low, late) in enumerate(self._lowest):
                above = max(line.lead + line.rate * (at - line.time) - low, 0.0)
                self._lowest[number] = at, low + min(off + above, 0.0), late
        # Less what its exchange took longer than the promptest one: by so much it may be late.
        self._all.append((time, lead + off - max(later - self._promptest - self._bits, 0.0)))
        part = _MIN_PART
        self._lowest = [each for each in self._lowest if time - each[0] <= WINDOW]
        while self._lowest and time - self._lowest[0][0] > _PARTS * part:
            part *= 2
        kept, self._lowest = (*self._lowest, (time, lead + off, later)), []
        for each in kept:
            if self._lowest and each[0] // part == (before := self._lowest[-1])[0] // part:
                if each[1] > before[1] + line.rate * (each[0] - before[0]) + _STEP / 2:
                    continue
                self._lowest.pop()
            self._lowest.append(each)
        if self._lowest[-1][0] == time:
            self._fit(time)
        return lead + off

    def _compare(self, time: float, lead: float) -> None:
        """Note a Mark, and lay a line through what it differs by from the other clock.

        What is likely of two crystals counts as if it were measured, too. Marks that most others
        contradict do not count.
        """
        self._marked = {at: each for at, each in self._marked.items() if time - at <= _MARKED}
        self._marked[time] = lead
        others = {} if self._other is None else self._other._marked
        both = [(at, each - others[at]) for at, each in self._marked.items() if at in others]
        # Where a Mark or the reply that showed it was lost the present clock is shown: by median.
        rate, near = self._beside.rate, _NEAR + 2 * self.stated / _PER_ERROR
        level, middle = median_low([(each - rate * at, at) for at, each in both] or [(0.0, time)])
        both = [
            (at, each)
            for at, each in both
            if abs(each - rate * at - level) <= near + MAX_CLOCK_RATE * abs(at - middle)
        ]
        if len(both) < _AGREEING:
            return
        newest, count = both[-1][0], len(both)
        middle = sum([newest - at for at, _ in both]) / count
        mean = sum([each for _, each in both]) / count
        slope, breadth = 0.0, (_LEAST / _EXPECTED_RATE) ** 2
        for at, each in both:
            since = at - newest + middle
            slope, breadth = slope + since * (each - mean), breadth + since**2
        rate = slope / breadth
        error = _LEAST * math.sqrt(1 / count + middle**2 / breadth)
        rate_error = _LEAST / math.sqrt(breadth)
        self._beside = _Line(newest, mean + rate * middle, rate, 0.0, error, rate_error)

    def _fit(self, time: float) -> None:
        """Lay a line that may bend through the lower half of what is kept, by least squares.

        What is likely of crystals counts as if it were measured, too.
        """
        rate, bend = self._line.rate, self._line.bend
        aged = [(time - at, lead, late) for at, lead, late in self._lowest]
        count = max(len(aged) // 2, 1)
        # One alone may be as late as its whole exchange, few nearly so, though they lie on a line.
        delay = self.shortest if count > 1 else self._lowest[0][2] - self._bits
        least = (delay / len(aged) ** 2) ** 2 / 12 + _LEAST**2
        for _ in range(_ROUNDS):  # what leads are at that time
            above = sorted([(lead + (rate - bend * age) * age, age) for age, lead, _ in aged])
            lowest = above[:count]
            mean = middle = breadth = scatter = slope = curve = wide = 0.0
            for high, age in lowest:
                mean, middle = mean + high / count, middle + age / count
            for high, age in lowest:
                breadth += (middle - age) ** 2
                slope += (middle - age) * (high - mean)
                scatter += (high - mean) ** 2
            for high, age in lowest:
                square = (middle - age) ** 2 - breadth / count
                curve, wide = curve + square * high, wide + square**2
            off_line = max(scatter - slope**2 / (breadth or 1.0), 0.0)
            error = off_line / count + least
            square = middle**2 - breadth / count
            breadth, wide = breadth + error / _EXPECTED_RATE**2, wide + error / _EXPECTED_BEND**2
            tilt = (slope - (rate - 2 * bend * middle) * error / _EXPECTED_RATE**2) / breadth
            warp = (curve - bend * error / _EXPECTED_BEND**2) / wide
            rate, bend = rate + tilt + 2 * warp * middle, bend + warp
            lead = mean + tilt * middle + warp * square
        # Where readings lie on a line by chance those above it show how late they may be.
        scatter = (above[min(count, len(aged) - 1)][0] - mean) ** 2 + least
        errors = _ERRORS + min(_RECENT / len(aged), 1.0)
        rate_error = errors * math.sqrt(scatter * (1 / breadth + (2 * middle) ** 2 / wide))
        error = errors * math.sqrt(scatter * (1 / count + middle**2 / breadth + square**2 / wide))
        recent = [
            (high + (rate - bend * age) * age - lead, late - self._promptest - self._bits)
            for age, high, late in aged[-_RECENT:]
        ]
        # None is later than its exchange took longer than the promptest one.
        if min([off - late for off, late in recent]) > _FAR / 2:
            del self._lowest[:-_RECENT]
        error = max(error, min(recent)[0])
        # Few far before most: most are late, or few are read wrong. Each is half the gap away.
        bulk = sorted([each + (rate - bend * (time - at)) * (time - at) for at, each in self._all])
        eighth = len(bulk) // 8
        low, high = above[0][0], bulk[eighth]
        if len(bulk) == _BULK and high - low > _FAR_OUT * (bulk[~eighth] - high):
            lead, error = (low + high) / 2, error + (high - low) / 2
        self._line = _Line(time, lead, rate, bend, error, rate_error)
