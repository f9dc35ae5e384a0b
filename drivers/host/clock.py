"""The clock of an amplifier: reading and steering it, and the reports in statuses.

Reading. An amplifier reads its clock for a Status between the last bit of the request and the first
bit of the reply. The *lead* of a reading is the clock's value minus the earliest arrival of the
request. USB frames, other traffic and operating systems delay a request and never speed it up, so a
reading shows at least the true lead, and the lowest readings are nearly right. The way back, with
its latency timers, has no influence. The time window is divided into parts of at most a quarter of
a second, the lowest reading of each part is kept, and a line is fitted by least squares to the
lower half of the kept readings. (The lowest readings alone are best if frames delay requests; their
mean is best if the operating system does.) Readings above the line show the possible delay. The
shift and rate sent by the host are subtracted first, so that steering does not feed back into the
measurement.

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
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
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
    REQUESTS,
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
_LIMITED = 1 << STATUS_FLAGS["limited"]
_OPEN = 1 << STATUS_FLAGS["interlock_open"]
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
        "its clock cannot be steered: its ERAs are not synchronized with those of others",
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
_PARTS = 32
"""Parts of that window, with one reading kept per part."""
_MIN_PART = 2.0**-8
"""Shortest length of a part [s]."""
_MARK_WINDOW = 1.0
"""Time window of Marks [s] for comparing clocks: over a longer time a crystal drifts."""
_MIN_MARKS = 3
"""Minimum number of Marks for a comparison: if only two differ, either can be false."""
_ITERATIONS = 3
"""Iterations of fitting the lead and selecting the readings that are fitted."""
_RECENT = 8
"""Number of recent readings. If all recent readings are above the fit, the fit may be too low by
the smallest distance; if they are far above it, the clock was moved."""
_BULK = 64
"""Number of latest readings that are compared with the lowest ones."""
_FAR_OUT = 2.0
"""Readings further below the latest ones than this multiple of their range, without the highest and
lowest eighth, are few and doubtful."""
_ERROR_FACTOR = 1.4
"""Factor of a standard error, from a simulation: the lowest of several readings are correlated."""
_EXPECTED_RATE = 50e-6
"""Expected rate of a crystal relative to the host's; a larger rate needs a good measurement."""
_MAX_CRYSTAL = 0.01
"""Rate impossible for an oscillator: beyond it, a clock has stopped or runs backwards."""
_EXPECTED_BEND = 2e-7
"""Half of the expected change of a crystal's rate [1/s] while it warms up."""
_MIN_ERROR = 5e-7
"""Minimum error [s] of a reading, and of the time that this process reads."""
_FAR = 100e-6
_FAR_ERRORS = 10.0
"""A reading that is further off, in seconds plus standard errors, shows a clock that was moved."""
_TOO_FAST = 1e-3
"""Tolerance [s] of a clock's gain beyond its crystal, due to reading errors."""
_NEAR = 20e-6
"""A clock is steered to zero within this error [s], or within its own error."""
_SIGNIFICANT = 4.0
"""Number of standard errors beyond which a difference is significant."""
_STEP = CLOCK_TURN / SPAN
"""Step [s] of a clock on the wire."""
_PER_RATE = QUANTITIES["rate"].per_unit
_PER_ERROR = QUANTITIES["clock_error"].per_unit


class _Steering(NamedTuple):
    """How fast a lead is steered to zero."""

    time: float
    """Time in which it is steered to zero [s], unless the rate would be too high."""
    max_rate: float
    """Highest rate."""

    def rate(self, lead: float) -> float:
        """Return the rate that steers a lead [s] to zero."""
        return -_limited(lead / self.time, self.max_rate)


_GENTLE = _Steering(0.5, 1e-4)
"""While something plays: the rate is not felt."""
_FAST = _Steering(0.2, 2.8e-3)
"""While nothing plays: four Pings, since lost ones would overshoot; the highest rate of a Ping."""
_COMMON = _Steering(0.5, 5e-4)
"""For the lead that all clocks of a line share. Their Pings are sequential: with a higher rate the
clocks would diverge."""


class _Reading(NamedTuple):
    """A reading of a clock, without what steering has added."""

    time: float
    """When the request arrives at the earliest [s]."""
    lead: float
    """Lead at that time [s]: the true lead plus the delay of the request."""
    max_delay: float
    """Largest possible delay [s], or 0 if it is subtracted already."""


class _LeadFit(NamedTuple):
    """The lead of a clock as a function of time, without what steering has added.

    lead(t) = offset + rate (t - time) + bend (t - time)^2
    """

    time: float
    """The moment to which the coefficients refer [s]."""
    offset: float = 0.0
    """Lead at that moment [s]."""
    rate: float = 0.0
    """Change of the lead at that moment [s/s]."""
    bend: float = 0.0
    """Half of the change of the rate [1/s]."""
    error: float = math.inf
    """Standard error of the offset [s]."""
    rate_error: float = _EXPECTED_RATE
    """Standard error of the rate."""

    def on_line(self, time: float) -> float:
        """Return the lead at a time [s] on the tangent, without the bend."""
        return self.offset + self.rate * (time - self.time)

    def at(self, time: float) -> "_LeadFit":
        """Return the tangent with its coefficients at another time [s]."""
        ahead_by = time - self.time
        offset = self.offset + self.rate * ahead_by
        error = self.error + self.rate_error * max(0.0, ahead_by)
        return _LeadFit(time, offset, self.rate, 0.0, error, self.rate_error)

    def plus(self, difference: "_LeadFit") -> "_LeadFit":
        """Return the lead of a clock that differs from this one; both are for the same time."""
        return _LeadFit(
            self.time,
            self.offset + difference.offset,
            self.rate + difference.rate,
            0.0,
            self.error + difference.error,
            self.rate_error + difference.rate_error,
        )


class _Moments(NamedTuple):
    """Sums over leads y at times x relative to the mean time; z = x^2 - mean(x^2)."""

    mean_lead: float
    mean_age: float
    xx: float
    xy: float
    yy: float
    """The sum of (y - mean(y))^2."""
    zy: float
    zz: float


def _moments(leads: Sequence[tuple[float, float]]) -> _Moments:
    """Return the moments of leads [s], which are given with their ages [s]."""
    count = len(leads)
    mean_lead = mean_age = 0.0
    for lead, age in leads:
        mean_lead += lead / count
        mean_age += age / count
    xx = xy = yy = 0.0
    for lead, age in leads:
        x = mean_age - age
        y = lead - mean_lead
        xx += x**2
        xy += x * y
        yy += y**2
    zy = zz = 0.0
    for lead, age in leads:
        z = (mean_age - age) ** 2 - xx / count
        zy += z * lead
        zz += z**2
    return _Moments(mean_lead, mean_age, xx, xy, yy, zy, zz)


def _aged_leads(readings: Iterable[_Reading], time: float) -> list[tuple[float, float]]:
    """Return the leads of readings and their ages at a time [s]."""
    return [(lead, time - at) for at, lead, _ in readings]


def _current_leads(
    aged_leads: Sequence[tuple[float, float]], rate: float, bend: float
) -> list[tuple[float, float]]:
    """Return the leads that readings predict for age 0, where rate and bend apply, and the ages."""
    return [(lead + (rate - bend * age) * age, age) for lead, age in aged_leads]


class _LowestFit(NamedTuple):
    """A fit to the lower half of readings."""

    fit: _LeadFit
    lowest_lead: float
    """The lowest of the readings [s], brought to the time of the fit."""


def _fit_lower_half(
    readings: Sequence[_Reading], last_fit: _LeadFit, time: float, min_variance: float
) -> _LowestFit:
    """Fit a lead at a time [s] to the lower half of readings by weighted least squares.

    Each iteration brings the leads of the readings to that time with the previous rate and bend. A
    quadratic regression through the lower half of these leads then corrects rate and bend:

        y = mean(y) + rate_change x + bend_change z + residual
        rate_change = (sum(x y) - prior) / rate_weight, rate_weight = sum(x^2) + prior weight
        bend_change = (sum(z y) - prior) / bend_weight, bend_weight = sum(z^2) + prior weight

    x is the time relative to the mean time of the selected readings, and z = x^2 - mean(x^2). The
    three regressors 1, x and z are taken as orthogonal, as they are for evenly spaced readings. The
    priors state that the rate in the middle of the readings and the bend are zero, within the
    errors expected for crystals; the weight of a prior is the variance of the residuals divided by
    the square of the expected error. min_variance: lower limit of the variance [s^2].
    """
    count = max(len(readings) // 2, 1)
    rate = last_fit.rate
    bend = last_fit.bend
    aged_leads = _aged_leads(readings, time)
    for _ in range(_ITERATIONS):
        leads = sorted(_current_leads(aged_leads, rate, bend))
        moments = _moments(leads[:count])
        mean_age = moments.mean_age
        residual_sum = moments.yy - moments.xy**2 / (moments.xx or 1.0)
        variance = max(residual_sum, 0.0) / count + min_variance
        rate_weight = moments.xx + variance / _EXPECTED_RATE**2
        bend_weight = moments.zz + variance / _EXPECTED_BEND**2
        rate_prior = (rate - 2 * bend * mean_age) * variance / _EXPECTED_RATE**2
        bend_prior = bend * variance / _EXPECTED_BEND**2
        rate_change = (moments.xy - rate_prior) / rate_weight
        bend_change = (moments.zy - bend_prior) / bend_weight
        rate = rate + rate_change + 2 * bend_change * mean_age
        bend = bend + bend_change
    # At the time of the fit, x is the mean age.
    now_z = mean_age**2 - moments.xx / count
    offset = moments.mean_lead + rate_change * mean_age + bend_change * now_z
    # Readings can be on a line by chance; the next one above it shows their possible delay.
    next_lead, _ = leads[min(count, len(leads) - 1)]
    variance = (next_lead - moments.mean_lead) ** 2 + min_variance
    error_factor = _ERROR_FACTOR + min(_RECENT / len(leads), 1.0)
    offset_scale = 1 / count + mean_age**2 / rate_weight + now_z**2 / bend_weight
    rate_scale = 1 / rate_weight + (2 * mean_age) ** 2 / bend_weight
    error = error_factor * math.sqrt(variance * offset_scale)
    rate_error = error_factor * math.sqrt(variance * rate_scale)
    lowest_lead, _ = leads[0]
    return _LowestFit(_LeadFit(time, offset, rate, bend, error, rate_error), lowest_lead)


def _fit_difference(differences: Sequence[tuple[float, float]]) -> _LeadFit:
    """Fit a line to leads [s] of a clock over another one, given with their times [s].

    The rate that is likely between two crystals serves as a prior.
    """
    newest, _ = differences[-1]
    leads = [(lead, newest - time) for time, lead in differences]
    moments = _moments(leads)
    rate_weight = moments.xx + (_MIN_ERROR / _EXPECTED_RATE) ** 2
    rate = moments.xy / rate_weight
    offset = moments.mean_lead + rate * moments.mean_age
    error = _MIN_ERROR * math.sqrt(1 / len(leads) + moments.mean_age**2 / rate_weight)
    rate_error = _MIN_ERROR / math.sqrt(rate_weight)
    return _LeadFit(newest, offset, rate, 0.0, error, rate_error)


class _AloneReading(NamedTuple):
    """A reading of a clock that is alone."""

    clock: int = 0
    """In units of the wire."""
    sent_at: float = -math.inf
    """When the request was sent [s]: it is read after this."""
    received_at: float = 0.0
    """When the reply came [s]: it is read before this."""


class _Pings(NamedTuple):
    """Pings that have no reply yet."""

    first_arrives_at: float
    """In s, at the earliest."""
    last_arrives_at: float
    """In s, at the earliest."""


@dataclass(eq=False)
class HeldClock:
    """The clock of an amplifier, as its messages show it; times [s] are of the host's clock."""

    stated: int = CLOCK_UNKNOWN
    """Its `clock_error` in units of the wire."""
    can_be_steered: bool = False
    """Whether it obeys shift and rate."""
    is_alone: bool = True
    """Whether there is no other clock to synchronise with; then it is rarely read."""
    _has_bits: bool = True
    """Whether messages take the time of their bits; False once a reply came sooner than that, as
    over a network or USB."""
    _reply_bits: float = 0.0
    """Time that the bits of a Status take [s]."""
    _min_exchange: float = math.inf
    """The shortest exchange, less its bits [s]."""
    _leader: "HeldClock | None" = None
    """The clock that it follows, see `compare`."""
    _is_leader: bool = False
    """Whether others follow it."""
    _sent_at: float = 0.0
    """When the request for the next Status was sent [s]."""
    _arrives_at: float = 0.0
    """When that request arrives at the earliest [s]."""
    _mark_count: int = 0
    """Number of Marks since the last Status; the next Status can show any Mark."""
    _pings: _Pings | None = None
    """Pings without reply, if any: the clock may have obeyed only some."""
    _unconfirmed_shift: int = 0
    """The shift of an Arm that has no reply yet."""
    _is_armed: bool = False
    _jumped_at: float = -math.inf
    """When it last jumped [s]."""
    _near_at: float = 0.0
    """When its lead was last near zero [s]."""
    _alone_reading: _AloneReading = field(default_factory=_AloneReading)
    """The last reading that counts while it is alone."""
    _steered_rate: float = 0.0
    """Rate of the last Ping [s/s]."""
    _steered_lead: float = field(init=False)
    """Shifts and rates have added `_steered_lead + _steered_rate * time` [s] to it."""
    _kept: list[_Reading] = field(init=False)
    """The lowest reading of each part of the time window."""
    _latest: deque[_Reading] = field(init=False)
    """The latest readings, without their possible delays."""
    _fit: _LeadFit = field(init=False)
    """The lead over the host's clock."""
    _mark_leads: dict[float, float] = field(init=False)
    """Lead at each Mark [s], by the time of its arrival [s]."""
    _difference: _LeadFit = field(init=False)
    """The lead over the clock that it follows, at their newest Mark."""
    _is_doubted: bool = field(init=False)
    """Whether only the last reading was impossibly early."""

    def __post_init__(self) -> None:
        """Begin without readings."""
        self._forget(0.0)

    def _forget(self, time: float) -> None:
        """Drop all readings, as if the clock had never been read before this time [s]."""
        self._kept = []
        self._latest = deque(maxlen=_BULK)
        self._fit = _LeadFit(time)
        self._mark_leads = {}
        self._difference = _LeadFit(-math.inf)
        self._steered_lead = -self._steered_rate * time
        self._is_doubted = False

    def identified(self, stated: int, *, bits: float) -> None:
        """Note its `clock_error` in units of the wire; bits: how long a Status takes [s]."""
        self.stated = stated
        self.can_be_steered = stated != CLOCK_UNKNOWN
        self._reply_bits = bits if self._has_bits else 0.0

    @property
    def shortest(self) -> float:
        """Its shortest exchange less the bits [s]; its division between both ways is unknown."""
        return max(self._min_exchange, 0.0)

    @property
    def is_compared(self) -> bool:
        """Whether Marks have shown how it differs from the clock that it follows."""
        return self._compared_leader is not None

    @property
    def _compared_leader(self) -> "HeldClock | None":
        """The clock that it follows, if it is compared with it."""
        leader = self._leader
        if leader is None or self._difference.time not in leader._mark_leads:
            return None
        return leader

    def compare(self, other: "HeldClock | None") -> None:
        """Let it follow another clock of its line, by Marks that both have shown; None: the host's.

        A delay of a Mark is the same for both clocks, so it does not affect their difference.
        """
        if other is not self._leader:
            self._leader = other
            self._difference = _LeadFit(-math.inf)
        self._is_leader = other is None

    def _fit_at(self, time: float) -> _LeadFit:
        """Return its lead at a time [s], by way of the clock that it follows, if any."""
        leader = self._compared_leader
        if leader is None:
            return self._fit.at(time)
        return leader._fit.at(time).plus(self._difference.at(time))

    def lead(self, time: float) -> float:
        """Return how far it is ahead of the host's clock at a time [s]; 0 before it is read."""
        unsteered = self._fit_at(time).offset
        return math.remainder(
            unsteered + self._steered_lead + self._steered_rate * time, CLOCK_TURN
        )

    def scatter(self, time: float) -> float:
        """Return the standard error of its measured lead [s]; infinite if it must be read again."""
        return math.inf if self._is_doubted else self._fit_at(time).error

    def error(self, time: float, *, off: float | None = None, is_common: bool = False) -> float:
        """Return its error [s rms], including the amplifier's specified error; infinite if unknown.

        off: its lead over the others [s]; None: over the host's clock. This counts only while it is
        armed, because it is steered to zero. is_common: whether the error is relative to others of
        its line that follow the same clock.
        """
        if not self.can_be_steered or self.problem(time) in ("clock_jumped", "clock_unsettled"):
            return math.inf
        lead = 0.0
        if self._is_armed:
            lead = self.lead(time) if off is None else off
        if not is_common:
            measured = self._fit_at(time).error
        elif self.is_compared:
            measured = self._difference.at(time).error
        else:
            measured = 0.0
        return math.hypot(self.stated / _PER_ERROR / math.sqrt(3), measured, lead)

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
        rate = abs(self._fit.rate)
        is_off = rate - _SIGNIFICANT * self._fit.rate_error > MAX_CLOCK_RATE
        if not is_off or len(self._kept) <= _PARTS // 2:
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
        lead = self.lead(time) if is_trusted else 0.0
        fit = self._fit_at(time)
        leader = self._compared_leader
        if leader is not None:
            common_lead = leader.lead(time) if is_trusted else 0.0
            own_error = self._difference.error
        else:
            common_lead = lead if self._is_leader else 0.0
            own_error = self._fit.error
        own_lead = lead - common_lead
        near = max(_NEAR, 2 * fit.error)  # a lead within its error is no fault of the clock
        # A follower is near if it is near its leader, which checks the common lead.
        max_common_lead = max(near, _COMMON.max_rate * CLOCK_SETTLING)
        is_common_near = leader is not None or abs(common_lead) <= max_common_lead
        if abs(own_lead) <= near and is_common_near:
            self._near_at = time
        is_gentle = is_playing or abs(own_lead) <= max(_NEAR, own_error)
        own_steering = _GENTLE if is_gentle else _FAST
        steering = _COMMON.rate(common_lead) + own_steering.rate(own_lead)
        crystal = _limited(fit.rate, MAX_CLOCK_RATE)
        return round((_limited(steering, _FAST.max_rate) - crystal) * _PER_RATE)

    def sent(self, name: str, values: Values, now: float, arrives: float) -> None:
        """Note a request that is sent now; arrives: when it does so at the earliest [s]."""
        if not self._has_bits:
            arrives = now
        if name == "Mark":
            self._mark_count += 1
        if name == "Mark" or not self._mark_count:
            self._sent_at = now
            self._arrives_at = arrives
        if self.is_alone:
            return
        if name == "Arm":
            self._unconfirmed_shift = values["shift"]
        elif name == "Ping":
            first = arrives if self._pings is None else self._pings.first_arrives_at
            self._pings = _Pings(first, arrives)

    def replied(self, name: str, values: Values, status: Values, received: float) -> None:
        """Note a Status that replies to a request at a time [s]."""
        mark_count = self._mark_count
        self._mark_count = 0
        was_armed = self._is_armed
        self._is_armed = status["state"] == ENABLED
        is_still_armed = was_armed and self._is_armed
        was_disarmed = was_armed and not self._is_armed
        if self.is_alone:
            is_reported = is_still_armed and name != "Arm" and not mark_count
            self._check_pace(status["clock"], received, is_reported=is_reported)
            return
        self._check_bits(received)
        time = min(self._arrives_at, received)
        if time - self._difference.time > _MARK_WINDOW:  # the last common Mark is too old
            self._difference = _LeadFit(-math.inf)
        if name == "Arm" and self._is_armed:
            self._steered_lead += values["shift"] * HIGH_TIME
            self._near_at = time
        elif self._unconfirmed_shift or (was_disarmed and not REQUESTS[name].disarms):
            self._forget(time)  # it is unknown if it was shifted, or when its rate ended
        self._unconfirmed_shift = 0
        self._min_exchange = min(self._min_exchange, received - time - self._reply_bits)
        # The reply to the next Ping shows whether one without reply was heard. Until then the rate
        # is unknown, and readings do not count.
        is_rate_known = self._pings is None or name == "Ping"
        if mark_count <= 1 and (is_rate_known or not self._kept):
            lead = self._read(status["clock"], time, received, is_reported=is_still_armed)
            if is_rate_known and mark_count:
                self._add_mark(time, lead)
            if not is_rate_known:  # this reading is used only until the first valid one
                self._kept.clear()
        if name == "Ping" or not self._is_armed:
            self._note_rate(values["rate"] / _PER_RATE if self._is_armed else 0.0, time)

    def _check_bits(self, received: float) -> None:
        """Drop the time of bits if a reply is received [s] before its request can have arrived.

        A reply may have fewer bits than stated, because CAN may stuff less; a request may not.
        """
        if self._has_bits and received < self._arrives_at:
            self._has_bits = False
            self._reply_bits = 0.0
            self._min_exchange = math.inf
            self._arrives_at = self._sent_at
            self._forget(self._sent_at)

    def _note_rate(self, rate: float, time: float) -> None:
        """Note the rate that a status at a time [s] confirms."""
        since = time
        if self._pings is not None:  # any Ping may be the first to arrive
            since = (self._pings.first_arrives_at + self._pings.last_arrives_at) / 2
        self._steered_lead += (self._steered_rate - rate) * since
        self._steered_rate = rate
        self._pings = None

    def _check_pace(self, clock: int, received: float, *, is_reported: bool) -> None:
        """Compare the time that has passed on a clock that is alone with the host's, every 3 s."""
        last = self._alone_reading
        max_passed = received - last.sent_at
        if is_reported and max_passed < CLOCK_SETTLING:
            min_passed = self._sent_at - last.received_at
            passed = ahead(clock, last.clock)
            tolerance = _FAR + _MAX_CRYSTAL * max_passed
            if min_passed - tolerance <= passed <= max_passed + tolerance:
                return
            self._jumped_at = received
        self._alone_reading = _AloneReading(clock, self._sent_at, received)

    def _read(self, clock: int, time: float, received: float, *, is_reported: bool) -> float:
        """Process a reading of the clock, and return the lead that it shows without steering [s].

        time: when the request arrives at the earliest [s]; received: when the reply came [s].
        is_reported: whether a jump is a problem, since no restart of the amplifier can explain it.
        """
        max_early = time - self._sent_at
        # The difference is negative if the bits take less time than they should.
        max_delay = abs(received - self._arrives_at)
        fit = self._fit
        unsteered = clock * _STEP - time - self._steered_lead - self._steered_rate * time
        expected = fit.on_line(time)
        off = math.remainder(unsteered - expected, CLOCK_TURN)
        error = self._fit_at(time).error
        far = _FAR + _FAR_ERRORS * error + self.stated / _PER_ERROR
        lowest, highest = self._possible_leads(time)
        is_early = off < lowest - expected - far - max_early
        is_late = off > max_delay + far or off > max_delay + highest - expected + _TOO_FAST
        self._is_doubted = is_early and not self._is_doubted
        if self._is_doubted:  # a single such reading may show a Mark that came twice
            return expected + off
        if is_early or is_late:
            if is_reported:
                self._jumped_at = time
            self._forget(time)
            lead = math.remainder(clock * _STEP - time, CLOCK_TURN)
        else:
            lead = expected + off
            if off < -_FAR - _SIGNIFICANT * error:
                self._lower_kept(off)
        # It may be late by as much as its exchange took longer than the shortest one.
        delay = max(max_delay - self._min_exchange - self._reply_bits, 0.0)
        self._latest.append(_Reading(time, lead - delay, 0.0))
        self._keep(_Reading(time, lead, max_delay))
        if self._kept[-1].time == time:
            self._update_fit(time)
        return lead

    def _possible_leads(self, time: float) -> tuple[float, float]:
        """Return the lowest and the highest lead [s] at a time [s] that kept readings allow.

        No kept reading was later than its exchange took: this gives a lower bound. No reading shows
        less than the true lead, so a reading that is above a kept one by more than any crystal
        gains shows that the clock runs too fast.
        """
        rate = self._fit.rate
        lows = [lead - max_delay - rate * (at - time) for at, lead, max_delay in self._kept]
        highs = [lead + _MAX_CRYSTAL * (time - at) for at, lead, _ in self._kept]
        return max(lows, default=-math.inf), min(highs, default=math.inf)

    def _lower_kept(self, off: float) -> None:
        """Lower the kept readings because a reading is far below the fit, by -off [s]."""
        for number, reading in enumerate(self._kept):
            below_fit = max(self._fit.on_line(reading.time) - reading.lead, 0.0)
            lead = reading.lead + min(off + below_fit, 0.0)
            self._kept[number] = reading._replace(lead=lead)

    def _keep(self, newest: _Reading) -> None:
        """Keep the lowest reading of each part of the window, which ends with the newest one."""
        recent = [reading for reading in self._kept if newest.time - reading.time <= _WINDOW]
        part = _MIN_PART
        while recent and newest.time - recent[0].time > _PARTS * part:
            part *= 2
        recent.append(newest)
        self._kept = []
        for reading in recent:
            if self._kept:
                last = self._kept[-1]
                if reading.time // part == last.time // part:
                    expected = last.lead + self._fit.rate * (reading.time - last.time)
                    if reading.lead > expected + _STEP / 2:
                        continue
                    self._kept.pop()
            self._kept.append(reading)

    def _add_mark(self, time: float, lead: float) -> None:
        """Note the lead [s] at a Mark, and fit the lead over the clock that it follows.

        Marks that contradict most others do not count: if a Mark or its reply was lost, the clock
        of another moment is shown. Only differences near the median count.
        """
        for mark_at in [*self._mark_leads]:
            if time - mark_at > _MARK_WINDOW:
                del self._mark_leads[mark_at]
        self._mark_leads[time] = lead
        if self._leader is None:
            return
        differences = []
        for mark_at, own_lead in self._mark_leads.items():
            leader_lead = self._leader._mark_leads.get(mark_at)
            if leader_lead is not None:
                differences.append((mark_at, own_lead - leader_lead))
        if len(differences) < _MIN_MARKS:
            return
        rate = self._difference.rate
        median, median_at = median_low([(offset - rate * at, at) for at, offset in differences])
        near = _NEAR + 2 * self.stated / _PER_ERROR
        agreeing = []
        for at, difference in differences:
            tolerance = near + MAX_CLOCK_RATE * abs(at - median_at)
            if abs(difference - rate * at - median) <= tolerance:
                agreeing.append((at, difference))
        if len(agreeing) >= _MIN_MARKS:
            self._difference = _fit_difference(agreeing)

    def _update_fit(self, time: float) -> None:
        """Fit the lead at a time [s], and check the fit against the latest readings."""
        kept = self._kept
        # A single reading may be as late as its whole exchange, and few readings nearly so, even if
        # they lie on a line.
        delay = self.shortest if len(kept) > 3 else kept[0].max_delay - self._reply_bits
        min_variance = (delay / len(kept) ** 2) ** 2 / 12 + _MIN_ERROR**2
        fit, lowest_lead = _fit_lower_half(kept, self._fit, time, min_variance)
        offset = fit.offset
        recent = kept[-_RECENT:]
        residuals = []
        sure_residuals = []  # after subtraction of the possible delays
        leads = _current_leads(_aged_leads(recent, time), fit.rate, fit.bend)
        for (lead, _), reading in zip(leads, recent, strict=True):
            delay = reading.max_delay - self._min_exchange - self._reply_bits
            residuals.append(lead - offset)
            sure_residuals.append(lead - offset - delay)
        # If even the recent readings that cannot be late are far above the fit, the clock was
        # moved, and the older readings are dropped.
        if min(sure_residuals) > _FAR / 2:
            del self._kept[:-_RECENT]
        error = max(fit.error, min(residuals))
        if len(self._latest) == _BULK:
            # A few readings far below most: either most are late, or the few are wrong. The lead is
            # taken in the middle, and its error includes half the gap.
            aged_leads = _aged_leads(self._latest, time)
            latest = sorted(_current_leads(aged_leads, fit.rate, fit.bend))
            low_end, _ = latest[_BULK // 8]
            high_end, _ = latest[-1 - _BULK // 8]
            gap = low_end - lowest_lead
            if gap > _FAR_OUT * (high_end - low_end):
                offset = (lowest_lead + low_end) / 2
                error += gap / 2
        self._fit = fit._replace(offset=offset, error=error)


def _limited(value: float, limit: float) -> float:
    """Return a value, or the nearest one from -limit to limit."""
    return min(max(value, -limit), limit)
