"""The clock of one amplifier: reading and steering it, and the reports in statuses.

Reading. An amplifier reads its clock for a Status between the last bit of the request and the first
bit of the reply. The *lead* of a reading is the clock's value minus the earliest arrival of the
request. USB frames, other traffic and operating systems delay a request and never
speed it up, so a reading shows at least the true lead, and the lowest readings are nearly right.
The way back, with its latency timers, has no influence. The time window is divided into parts of at
most a quarter of a second, the lowest reading of each part is kept, and a line is fitted by least
squares to the lower half of these. (The lowest readings alone are best if frames delay requests;
their mean is best if the operating system does.) Readings above the line show the possible delay.
The shift and rate sent by the host are subtracted first, so that steering does not feed back into
the measurement.

Steering. The shift is sent with Arm, to the nearest step of 305 us. The rate is sent with each
Ping: it cancels the rate of the crystal and leads the remaining lead to zero, fast while nothing
plays, and otherwise too slowly to be felt. A clock that cannot be steered or trusted has an
infinite error, and stops nothing.

Comparing. At a Mark all amplifiers of a line record their clocks at the same byte, independent of
its delay, so the differences between the clocks are as accurate as the amplifiers specify. One
clock of the line follows the host's clock, and the others follow that one.
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

_HOT = 70.0  # °C; a hotter amplifier is reported, and stops itself with a fault if necessary
REPORT_LIFE = 10.0
"""Time for which a report is shown after the last status with it [s]."""
_PER_DEGREE = QUANTITIES["temperature"].per_unit
_LIMITED, _OPEN = 1 << STATUS_FLAGS["limited"], 1 << STATUS_FLAGS["interlock_open"]
_HIGH_VOLTAGE = 1 << STATUS_FLAGS["high_voltage"]

CLOCK_SETTLING = 3.0
"""Time within which a clock must follow [s]; a clock that jumped is distrusted for as long."""
MAX_CLOCK_RATE = 2e-4
"""Largest rate of a crystal against the host's; a faster or slower one is broken."""

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
        "its clock cannot be steered: its ERAs are not synchronised with those of others",
        "update its firmware, or replace it",
    ),
    "clock_jumped": (
        "its clock jumps, stops, has a wrong rate, or has a larger reading error than specified",
        "check its clock and clock_error: era amp conformance; with others less is promised",
    ),
    "clock_rate": (
        f"its clock is more than {MAX_CLOCK_RATE * 1e6:g} ppm too fast or too slow",
        "check its crystal and its clock's units; less is promised meanwhile",
    ),
    "clock_unsettled": (
        f"its clock does not follow the host's within {CLOCK_SETTLING:g} s",
        "check that it obeys shift and rate: era amp conformance; less is promised meanwhile",
    ),
}
"""Cause and remedy of each kind of report: a condition in a status that is not a fault."""


def reports_of(status: Values, of_clock: ClockProblem | None = None) -> Sequence[ReportKind]:
    """Return the kinds of reports of a status; of_clock: the problem of its clock.

    Makes few calls, because it runs with every heartbeat.
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
    """Describe a value in a status that an armed amplifier must not report; None without one.

    latch: from the reply to Arm, or None before that; a newer stop or fault would have disarmed the
    amplifier.
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


_WINDOW = 8.0
"""Time window of readings [s]: fewer are noisier; over a longer time a warming crystal drifts."""
_PARTS, _MIN_PART = 32, 2.0**-8
"""Parts of that window, with one reading kept per part; shortest length of a part [s]."""
_MARKED = 1.0
"""Time window of Marks [s] for comparing clocks: over a longer time a crystal drifts."""
_AGREEING = 3
"""Minimum number of Marks for a comparison: if only two differ, either can be false."""
_ROUNDS = 3
"""Iterations of fitting a line and selecting the readings it passes through."""
_RECENT = 8
"""Number of latest readings. The line may be wrong by as much as all of them are above it; if they
are far above it, the clock was moved."""
_BULK, _FAR_OUT = 64, 2.0
"""Number of latest readings, and factor of their range without the highest and lowest eighth;
readings further below them than this multiple of the range are few and doubtful."""
_ERRORS = 1.4
"""Factor of a standard error, from a simulation: the lowest of several readings are correlated."""
_EXPECTED_RATE = 50e-6
"""Expected rate of a crystal relative to the host's; a larger rate needs a good measurement."""
_MAX_CRYSTAL = 0.01
"""Rate impossible for an oscillator: beyond it, a clock has stopped or runs backwards."""
_EXPECTED_BEND = 2e-7
"""Half of the expected change of a crystal's rate [1/s] while it warms up."""
_LEAST = 5e-7
"""Minimum error [s] of a reading, and of the time that this process reads."""
_FAR, _FAR_ERRORS = 100e-6, 10.0
"""A reading that is further off, in seconds plus standard errors, shows a clock that was moved."""
_TOO_FAST = 1e-3
"""Tolerance [s] of a clock's gain beyond its crystal, due to reading errors."""
_GENTLE = 0.5, 1e-4
"""Time [s] in which an error is steered to zero, and the maximum rate, which is not felt."""
_FAST = 0.2, 2.8e-3
"""The same while nothing plays: four Pings, since lost ones would overshoot; a Ping's highest."""
_TOGETHER = 0.5, 5e-4
"""The same for all clocks of a line, whose Pings are sequential: faster they would diverge."""
_NEAR = 20e-6
"""A clock is steered to zero within this error [s], or within its own error."""
_SURELY = 4.0
"""Number of standard errors beyond which a difference is significant."""
_STEP = CLOCK_TURN / SPAN
"""Step [s] of a clock on the wire."""
_PER_RATE, _PER_ERROR = QUANTITIES["rate"].per_unit, QUANTITIES["clock_error"].per_unit


class _Line(NamedTuple):
    """The lead of a clock as a function of time, without what steering has added."""

    time: float
    """The moment to which the other values refer [s]."""
    lead: float = 0.0
    """Lead at that moment [s]."""
    rate: float = 0.0
    """Change of the lead [s/s]."""
    bend: float = 0.0
    """Half of the change of the rate [1/s]."""
    error: float = math.inf
    """Standard error of the lead [s]."""
    rate_error: float = _EXPECTED_RATE
    """Standard error of the rate."""

    def at(self, time: float) -> "_Line":
        """Return the line with its values at another time [s]."""
        later = time - self.time
        error = self.error + self.rate_error * max(0.0, later)
        return _Line(time, self.lead + self.rate * later, self.rate, 0.0, error, self.rate_error)


class HeldClock:
    """The clock of an amplifier, as its messages show it; times [s] are of the host's clock."""

    def __init__(self) -> None:
        # Whether messages take the time of their bits; False once a reply came sooner than that,
        # as over a network or USB.
        self._has_bits = True
        self.identified(CLOCK_UNKNOWN, bits=0.0)
        self._promptest = math.inf  # s; the shortest exchange, less its bits
        self.is_alone = True
        """Whether there is no other clock to synchronise with; then it is rarely read."""
        self._other: HeldClock | None = None  # the clock it follows, see `compare`
        self._is_first = False  # whether others follow it
        self._pace = 0.0  # s/s; by the rate of the last Ping
        # When the request for a Status was sent, and when it arrives at the soonest [s].
        self._requested = 0.0, 0.0
        # Last value of a clock that is alone, and the times [s] around its reading.
        self._shown = 0, -math.inf, 0.0
        self._marks = 0  # sent since the last Status; the next Status can show any of them
        # When the first and the last Ping without reply arrive [s]; None without one.
        self._pinged: tuple[float, float] | None = None
        self._arming = 0  # the shift of an Arm that has no reply yet
        self._is_armed = False
        self._jumped_at = -math.inf
        self._near_at = 0.0  # s; when its lead was last near zero
        self._forget(0.0)

    def _forget(self, time: float) -> None:
        """Drop all readings, as if the clock had never been read before this time."""
        # Time, lead, and how late the reading may be at most; all in s.
        self._lowest: list[tuple[float, float, float]] = []
        self._all = deque[tuple[float, float]](maxlen=_BULK)  # times and leads
        self._line = _Line(time)
        self._marked: dict[float, float] = {}  # lead at each Mark, by the time of its arrival
        self._beside = _Line(-math.inf)  # lead against the other, at their newest Mark
        # Shifts and rates have added `_added + _pace * time` [s] to the clock.
        self._added = -self._pace * time
        self._is_doubted = False  # whether only the last reading was impossibly early

    def identified(self, stated: int, *, bits: float) -> None:
        """Note its `clock_error` in units of the wire; bits: how long a Status takes [s]."""
        self.stated, self.can_be_steered = stated, stated != CLOCK_UNKNOWN
        self._bits = bits if self._has_bits else 0.0

    @property
    def shortest(self) -> float:
        """Its shortest exchange less the bits [s]; how its two ways share it is unknown."""
        return max(self._promptest, 0.0)

    @property
    def is_compared(self) -> bool:
        """Whether Marks have shown how it differs from the clock to which it is held."""
        return self._first is not None

    @property
    def _first(self) -> "HeldClock | None":
        """The clock to which it is held, if it is compared with it."""
        other = self._other
        return other if other is not None and self._beside.time in other._marked else None

    def compare(self, other: "HeldClock | None") -> None:
        """Hold it to another clock of its line, by Marks that both have shown; None: to the host's.

        A delay of a Mark is the same for both clocks, so it does not affect their difference.
        """
        if other is not self._other:
            self._other, self._beside = other, _Line(-math.inf)
        self._is_first = other is None

    def _seen(self, time: float) -> _Line:
        """Return its line at a time [s], by way of the other clock if it is held to that one."""
        if (first := self._first) is None:
            return self._line.at(time)
        line, beside = first._line.at(time), self._beside.at(time)
        error, rate_error = line.error + beside.error, line.rate_error + beside.rate_error
        return _Line(time, line.lead + beside.lead, line.rate + beside.rate, 0.0, error, rate_error)

    def lead(self, time: float) -> float:
        """Return how far it is ahead of the host's clock at a time [s]; 0 before it is read."""
        unsteered = self._seen(time).lead
        return math.remainder(unsteered + self._added + self._pace * time, CLOCK_TURN)

    def scatter(self, time: float) -> float:
        """Return the standard error of its measured lead [s]; infinite if it must be read again."""
        return math.inf if self._is_doubted else self._seen(time).error

    def error(self, time: float, *, off: float | None = None, is_common: bool = False) -> float:
        """Return its error [s rms], including the amplifier's specified error; infinite if unknown.

        off: its lead over the others [s]; None: over the host's clock. This counts only while it is
        armed, because it is steered to zero. is_common: whether the error is relative to others of
        its line that follow the same clock.
        """
        if not self.can_be_steered or self.problem(time) in ("clock_jumped", "clock_unsettled"):
            return math.inf
        lead = (self.lead(time) if off is None else off) if self._is_armed else 0.0
        seen = self._seen(time).error
        if is_common:
            seen = self._beside.at(time).error if self.is_compared else 0.0
        return math.hypot(self.stated / _PER_ERROR / math.sqrt(3), seen, lead)

    def problem(self, time: float) -> ClockProblem | None:
        """Return its problem at a time [s]; None if it is fine."""
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
        near = max(_NEAR, 2 * line.error)  # a lead within its error is no fault of the clock
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
        """Note a request that is sent now; arrives: when it does so at the soonest [s]."""
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
        # A reply may have fewer bits than stated, because CAN may stuff less; a request may not.
        if self._has_bits and received < arrives:
            self._has_bits, self._bits, self._promptest, arrives = False, 0.0, math.inf, sent
            self._forget(sent)
        time = min(arrives, received)
        if time - self._beside.time > _MARKED:  # the last common Mark is too old
            self._beside = _Line(-math.inf)
        has_left = was_armed and not self._is_armed and name not in ("Stop", "Disarm")
        if name == "Arm" and self._is_armed:
            self._added += values["shift"] * HIGH_TIME
            self._near_at = time
        elif self._arming or has_left:  # it is unknown if it was shifted, or when its rate ended
            self._forget(time)
        self._arming = 0
        self._promptest = min(self._promptest, received - time - self._bits)
        # The reply to the next Ping shows whether one without reply was heard. Until then the rate
        # is unknown, and readings do not count.
        is_kept = self._pinged is None or name == "Ping"
        if marks <= 1 and (is_kept or not self._lowest):
            is_reported = was_armed and self._is_armed
            # The difference is negative if the bits take less time than they should.
            late = abs(received - arrives)
            lead = self._read(status["clock"], time, time - sent, late, is_reported=is_reported)
            if is_kept and marks:
                self._compare(time, lead)
            if not is_kept:  # this reading is used only until the first valid one
                self._lowest.clear()
        if name == "Ping" or not self._is_armed:
            pace = values["rate"] / _PER_RATE if self._is_armed else 0.0
            since = sum(self._pinged or (time, time)) / 2  # any of them may be the first to arrive
            self._added += (self._pace - pace) * since
            self._pace, self._pinged = pace, None

    def _check_pace(self, clock: int, sent: float, received: float, *, is_reported: bool) -> None:
        """Compare the time that has passed on a clock that is alone with the host's, every 3 s."""
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
        """Process a reading of the clock, and return the lead that it shows without steering [s].

        time: when the request arrives at the soonest [s]. earlier, later: by how much the clock may
        have been read earlier or later than that at most [s]. is_reported: whether a jump is a
        problem, since no restart of the amplifier can explain it.
        """
        line, shown = self._line, clock * _STEP - time - self._added - self._pace * time
        lead = line.lead + line.rate * (time - line.time)
        off = math.remainder(shown - lead, CLOCK_TURN)
        error = self._seen(time).error
        far = _FAR + _FAR_ERRORS * error + self.stated / _PER_ERROR
        # No earlier reading was later than its exchange took: this is a lower bound of the lead.
        sure = max(
            [low - late - line.rate * (at - time) for at, low, late in self._lowest],
            default=-math.inf,
        )
        # No reading shows less than the true lead, so if this one is above an earlier one by more
        # than any crystal gains, the clock runs too fast.
        highest = min(
            [low + _MAX_CRYSTAL * (time - at) for at, low, _ in self._lowest], default=math.inf
        )
        is_early = off < sure - lead - far - earlier
        self._is_doubted = is_early and not self._is_doubted
        if self._is_doubted:  # a single such reading may show a Mark that came twice
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
        # It may be late by as much as its exchange took longer than the shortest one.
        self._all.append((time, lead + off - max(later - self._promptest - self._bits, 0.0)))
        part = _MIN_PART
        self._lowest = [each for each in self._lowest if time - each[0] <= _WINDOW]
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
        """Note a Mark, and fit a line to the differences from the other clock.

        The rate that is likely between two crystals serves as a prior. Marks that contradict most
        others do not count.
        """
        self._marked = {at: each for at, each in self._marked.items() if time - at <= _MARKED}
        self._marked[time] = lead
        others = {} if self._other is None else self._other._marked
        both = [(at, each - others[at]) for at, each in self._marked.items() if at in others]
        # If a Mark or its reply was lost, the clock of another moment is shown. Only differences
        # near the median count.
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
        """Fit a line, which may bend, to the lower half of the kept readings by least squares.

        The rate and the bend that are likely for crystals serve as priors.
        """
        rate, bend = self._line.rate, self._line.bend
        aged = [(time - at, lead, late) for at, lead, late in self._lowest]
        count = max(len(aged) // 2, 1)
        # A single reading may be as late as its whole exchange, and few readings nearly so, even if
        # they lie on a line.
        delay = self.shortest if count > 1 else self._lowest[0][2] - self._bits
        least = (delay / len(aged) ** 2) ** 2 / 12 + _LEAST**2
        for _ in range(_ROUNDS):  # `above`: leads brought to this time, the lowest first
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
        # Readings can be on a line by chance; the next one above it shows their possible delay.
        scatter = (above[min(count, len(aged) - 1)][0] - mean) ** 2 + least
        errors = _ERRORS + min(_RECENT / len(aged), 1.0)
        rate_error = errors * math.sqrt(scatter * (1 / breadth + (2 * middle) ** 2 / wide))
        error = errors * math.sqrt(scatter * (1 / count + middle**2 / breadth + square**2 / wide))
        recent = [
            (high + (rate - bend * age) * age - lead, late - self._promptest - self._bits)
            for age, high, late in aged[-_RECENT:]
        ]
        # If even the recent readings that cannot be late are far above the line, the clock was
        # moved, and the older readings are dropped.
        if min([off - late for off, late in recent]) > _FAR / 2:
            del self._lowest[:-_RECENT]
        error = max(error, min(recent)[0])
        # A few readings far below most: either most are late, or the few are wrong. The line
        # passes through the middle, and its error includes half the gap.
        bulk = sorted([each + (rate - bend * (time - at)) * (time - at) for at, each in self._all])
        eighth = len(bulk) // 8
        low, high = above[0][0], bulk[eighth]
        if len(bulk) == _BULK and high - low > _FAR_OUT * (bulk[~eighth] - high):
            lead, error = (low + high) / 2, error + (high - low) / 2
        self._line = _Line(time, lead, rate, bend, error, rate_error)
