"""The clock of an amplifier, as its messages show it: read, steered, and compared with others.

`clock_readings` measures the lead over the host's clock, and `clock_steering` computes the shift
and the rates that lead it to zero. A clock that cannot be steered or trusted has an infinite error,
and stops nothing.

At a Mark all amplifiers of a line record their clocks at the same byte, independent of its delay,
so the differences between the clocks are as accurate as the amplifiers specify (`_Comparison`). One
clock of the line follows the host's clock, and the others follow that one.
"""

import math
from statistics import median_low
from typing import Literal, NamedTuple

from drivers.host.clock_readings import (
    CLOCK_STEP,
    FAR,
    MAX_CRYSTAL,
    SIGNIFICANT,
    ClockReadings,
    ReadingVerdict,
)
from drivers.host.clock_steering import (
    MAX_CLOCK_RATE,
    MAX_COMMON_RATE,
    SteeredLead,
    rate_against,
    shift_against,
)
from drivers.host.lead_fit import LeadFit, Reading, fit_difference
from drivers.protocol.definition import (
    CLOCK_TURN,
    CLOCK_UNKNOWN,
    ENABLED,
    QUANTITIES,
    REQUESTS,
    ahead,
)
from drivers.protocol.records import Values

CLOCK_SETTLING = 3.0
"""Time within which a clock must follow [s]; a clock that jumped is distrusted for as long."""
_MARK_WINDOW = 1.0
"""Time window of Marks [s] for comparing clocks: over a longer time a crystal drifts."""
_MIN_MARKS = 3
"""Minimum number of Marks for a comparison: if only two differ, either can be false."""
_NEAR = 20e-6
"""A clock is steered to zero within this error [s], or within its own error."""
_PER_ERROR = QUANTITIES["clock_error"].per_unit

ClockProblem = Literal["clock_not_steered", "clock_jumped", "clock_rate", "clock_unsettled"]


class _LoneReading(NamedTuple):
    """A reading of a clock that is alone."""

    clock: int
    """In units of the wire."""
    sent_at: float
    """When the request was sent [s]: it is read after this."""
    received_at: float
    """When the reply came [s]: it is read before this."""


class _Comparison:
    """The lead of a clock over the one that it follows, from Marks that both have shown."""

    leader: "HeldClock | None" = None
    """The clock that it follows; None: the host's."""
    mark_leads: dict[float, float]
    """Lead at each Mark [s] without the steered lead, by the time of its arrival [s]."""
    difference: LeadFit
    """The lead over the leader, at their newest Mark."""

    def __init__(self) -> None:
        self.forget()

    def forget(self) -> None:
        """Drop all Marks."""
        self.mark_leads = {}
        self.forget_difference()

    def forget_difference(self) -> None:
        """Drop the lead over the leader."""
        self.difference = LeadFit(-math.inf)

    def expire(self, time: float) -> None:
        """Drop the lead over the leader if the last common Mark is too old at a time [s]."""
        if time - self.difference.time > _MARK_WINDOW:
            self.forget_difference()

    def follow(self, leader: "HeldClock | None") -> None:
        """Compare with another clock from now on."""
        if leader is not self.leader:
            self.leader = leader
            self.forget_difference()

    @property
    def compared_leader(self) -> "HeldClock | None":
        """The leader, if the lead over it is known."""
        leader = self.leader
        if leader is None or leader.lead_at_mark(self.difference.time) is None:
            return None
        return leader

    def add_mark(self, time: float, lead: float, clock_error: float) -> None:
        """Note the lead [s] at a Mark, and fit the lead over the leader.

        clock_error: maximum reading error of the clock [s]. Marks that contradict most others do
        not count: if a Mark or its reply was lost, the clock of another moment is shown. Only
        differences near the median count.
        """
        for mark_at in [*self.mark_leads]:
            if time - mark_at > _MARK_WINDOW:
                del self.mark_leads[mark_at]
        self.mark_leads[time] = lead
        differences = self._common_differences()
        if len(differences) < _MIN_MARKS:
            return
        rate = self.difference.rate
        median, median_at = median_low([(lead - rate * at, at) for at, lead in differences])
        agreeing = []
        for at, difference in differences:
            tolerance = _NEAR + 2 * clock_error + MAX_CLOCK_RATE * abs(at - median_at)
            if abs(difference - rate * at - median) <= tolerance:
                agreeing.append((at, difference))
        if len(agreeing) >= _MIN_MARKS:
            self.difference = fit_difference(agreeing)

    def _common_differences(self) -> list[tuple[float, float]]:
        """Return the time of each common Mark [s], and the lead over the leader at it [s]."""
        differences: list[tuple[float, float]] = []
        if self.leader is None:
            return differences
        for mark_at, lead in self.mark_leads.items():
            leader_lead = self.leader.lead_at_mark(mark_at)
            if leader_lead is not None:
                differences.append((mark_at, lead - leader_lead))
        return differences


class HeldClock:
    """The clock of an amplifier; times [s] are of the host's clock.

    A clock that follows this one uses `fit_at`, `lead` and `lead_at_mark`.
    """

    stated: int = CLOCK_UNKNOWN
    """Its `clock_error` in units of the wire."""
    can_be_steered: bool = False
    """Whether it obeys shift and rate."""
    is_alone: bool = True
    """Whether there is no other clock to synchronise with; then it is rarely read."""
    _has_bits: bool = True
    """Whether messages take the time of their bits; False once a reply came sooner than that, as
    over a network or USB."""
    _is_leader: bool = False
    """Whether others follow it."""
    _sent_at: float = 0.0
    """When the request for the next Status was sent [s]."""
    _arrives_at: float = 0.0
    """When that request arrives at the earliest [s]."""
    _mark_count: int = 0
    """Number of Marks since the last Status; the next Status can show any Mark."""
    _is_armed: bool = False
    _jumped_at: float = -math.inf
    """When it last jumped [s]."""
    _near_at: float = 0.0
    """When its lead was last near zero [s]."""
    _lone_reading: _LoneReading | None = None
    """The last reading that counts while it is alone."""

    def __init__(self) -> None:
        self._readings = ClockReadings()
        self._steered = SteeredLead()
        self._comparison = _Comparison()

    def _forget(self, time: float) -> None:
        """Drop all readings, as if the clock had never been read before this time [s]."""
        self._readings.forget(time)
        self._comparison.forget()
        self._steered.restart(time)

    def identified(self, stated: int, *, bits: float) -> None:
        """Note its `clock_error` in units of the wire; bits: how long a Status takes [s]."""
        self.stated = stated
        self.can_be_steered = stated != CLOCK_UNKNOWN
        self._readings.reply_bits = bits if self._has_bits else 0.0

    @property
    def _max_reading_error(self) -> float:
        """Its `clock_error` in seconds."""
        return self.stated / _PER_ERROR

    @property
    def shortest(self) -> float:
        """Its shortest exchange less the bits [s]; its division between both ways is unknown."""
        return self._readings.shortest

    @property
    def is_compared(self) -> bool:
        """Whether Marks have shown how it differs from the clock that it follows."""
        return self._comparison.compared_leader is not None

    def compare(self, other: "HeldClock | None") -> None:
        """Let it follow another clock of its line, by Marks that both have shown; None: the host's.

        A delay of a Mark is the same for both clocks, so it does not affect their difference.
        """
        self._comparison.follow(other)
        self._is_leader = other is None

    def lead_at_mark(self, time: float) -> float | None:
        """Return its lead [s] without the steered lead at the Mark of a time [s], if known."""
        return self._comparison.mark_leads.get(time)

    def fit_at(self, time: float) -> LeadFit:
        """Return its lead without the steered lead at a time [s], by way of its leader, if any."""
        leader = self._comparison.compared_leader
        if leader is None:
            return self._readings.fit.at(time)
        return leader.fit_at(time).plus(self._comparison.difference.at(time))

    def _fit_error(self, time: float) -> float:
        """Return the standard error of the lead of `fit_at` [s]."""
        leader = self._comparison.compared_leader
        if leader is None:
            return self._readings.fit.error_at(time)
        return leader._fit_error(time) + self._comparison.difference.error_at(time)

    def lead(self, time: float) -> float:
        """Return how far it is ahead of the host's clock at a time [s]; 0 before it is read."""
        return self._with_steering(self.fit_at(time), time)

    def _with_steering(self, fit: LeadFit, time: float) -> float:
        """Return the lead of a fit at a time [s], with the steered lead."""
        return math.remainder(self._steered.add_to(fit.offset, time), CLOCK_TURN)

    def scatter(self, time: float) -> float:
        """Return the standard error of its measured lead [s]; infinite if it must be read again."""
        return math.inf if self._readings.is_doubted else self._fit_error(time)

    def error(self, time: float, *, off: float | None = None, is_common: bool = False) -> float:
        """Return its error [s rms], including the amplifier's specified error; infinite if unknown.

        off: its lead over the others [s]; None: over the host's clock. This counts only while it is
        armed, because it is steered to zero. is_common: whether the error is relative to others of
        its line that follow the same clock.
        """
        if not self._is_trusted(time):
            return math.inf
        fit = self.fit_at(time)
        lead = 0.0
        if self._is_armed:
            lead = self._with_steering(fit, time) if off is None else off
        if not is_common:
            measured = fit.error
        elif self.is_compared:
            measured = self._comparison.difference.at(time).error
        else:
            measured = 0.0
        return math.hypot(self._max_reading_error / math.sqrt(3), measured, lead)

    def is_synchronized(self, time: float) -> bool:
        """Whether its error at a time [s] is known."""
        return self._is_trusted(time) and self._fit_error(time) < math.inf

    def _is_trusted(self, time: float) -> bool:
        """Whether it can be steered, and has followed the host's clock until a time [s]."""
        has_failed = self.problem(time) in ("clock_jumped", "clock_unsettled")
        return self.can_be_steered and not has_failed

    def _has_jumped(self, time: float) -> bool:
        """Whether it has jumped a short time ago, and is not trusted at a time [s]."""
        return time - self._jumped_at < CLOCK_SETTLING

    def problem(self, time: float) -> ClockProblem | None:
        """Return its problem at a time [s]; None if it is fine."""
        has_jumped = self._has_jumped(time)
        if self.is_alone:
            return "clock_jumped" if has_jumped else None
        if not self.can_be_steered:
            return "clock_not_steered"
        if has_jumped:
            return "clock_jumped"
        if self._is_armed and time - self._near_at > CLOCK_SETTLING:
            return "clock_unsettled"
        fit = self._readings.fit
        rate = abs(fit.rate)
        is_off = rate - SIGNIFICANT * fit.rate_error > MAX_CLOCK_RATE
        if not is_off or not self._readings.are_many:
            return None
        return "clock_rate" if rate < MAX_CRYSTAL else "clock_jumped"

    def shift(self, time: float) -> int:
        """Return the shift of an Arm that is sent at a time [s]."""
        return shift_against(self.lead(time)) if self.can_be_steered else 0

    def rate(self, time: float, *, is_playing: bool) -> int:
        """Return the rate of a Ping that is sent at a time [s]; note if the lead is near zero."""
        if not self.can_be_steered:
            return 0
        is_trusted = not self._has_jumped(time)
        fit = self.fit_at(time)
        lead = self._with_steering(fit, time) if is_trusted else 0.0
        leader = self._comparison.compared_leader
        if leader is not None:
            common_lead = leader.lead(time) if is_trusted else 0.0
            own_error = self._comparison.difference.error
        else:
            common_lead = lead if self._is_leader else 0.0
            own_error = self._readings.fit.error
        own_lead = lead - common_lead
        near = max(_NEAR, 2 * fit.error)  # a lead within its error is no fault of the clock
        # A follower is near if it is near its leader, which checks the common lead.
        max_common_lead = max(near, MAX_COMMON_RATE * CLOCK_SETTLING)
        is_common_near = leader is not None or abs(common_lead) <= max_common_lead
        if abs(own_lead) <= near and is_common_near:
            self._near_at = time
        is_gentle = is_playing or abs(own_lead) <= max(_NEAR, own_error)
        return rate_against(own_lead, common_lead, fit.rate, is_gentle=is_gentle)

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
            self._steered.note_shift_sent(values["shift"])
        elif name == "Ping":
            self._steered.note_ping_sent(arrives)

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
        self._comparison.expire(time)
        self._note_shift(name, values, time, was_disarmed=was_disarmed)
        readings = self._readings
        exchange_time = received - time - readings.reply_bits
        readings.min_exchange = min(readings.min_exchange, exchange_time)
        # The reply to the next Ping shows whether one without reply was heard. Until then the rate
        # is unknown, and readings do not count.
        is_rate_known = self._steered.is_rate_known or name == "Ping"
        if mark_count <= 1 and (is_rate_known or readings.is_empty):
            lead = self._read(status["clock"], time, received, is_reported=is_still_armed)
            if is_rate_known and mark_count:
                self._comparison.add_mark(time, lead, self._max_reading_error)
            if not is_rate_known:  # this reading is used only until the first valid one
                readings.forget_kept()
        if name == "Ping" or not self._is_armed:
            self._steered.note_rate(values["rate"] if self._is_armed else 0, time)

    def _note_shift(self, name: str, values: Values, time: float, *, was_disarmed: bool) -> None:
        """Note a shift that a Status confirms, or forget the readings if a shift is unknown.

        time: when the request arrives at the earliest [s]. was_disarmed: whether the Status shows
        that the clock is no longer armed.
        """
        sent_shift = self._steered.take_sent_shift()
        if name == "Arm" and self._is_armed:
            self._steered.note_shift(values["shift"])
            self._near_at = time
        elif sent_shift or (was_disarmed and not REQUESTS[name].disarms):
            self._forget(time)  # it is unknown if it was shifted, or when its rate ended

    def _check_bits(self, received: float) -> None:
        """Drop the time of bits if a reply is received [s] before its request can have arrived.

        A reply may have fewer bits than stated, because CAN may stuff less; a request may not.
        """
        if self._has_bits and received < self._arrives_at:
            self._has_bits = False
            self._readings.reply_bits = 0.0
            self._readings.min_exchange = math.inf
            self._arrives_at = self._sent_at
            self._forget(self._sent_at)

    def _check_pace(self, clock: int, received: float, *, is_reported: bool) -> None:
        """Compare the time that has passed on a clock that is alone with the host's, every 3 s."""
        last = self._lone_reading
        if is_reported and last is not None and received - last.sent_at < CLOCK_SETTLING:
            max_passed = received - last.sent_at
            min_passed = self._sent_at - last.received_at
            tolerance = FAR + MAX_CRYSTAL * max_passed
            passed = ahead(clock, last.clock)
            if min_passed - tolerance <= passed <= max_passed + tolerance:
                return
            self._jumped_at = received
        self._lone_reading = _LoneReading(clock, self._sent_at, received)

    def _read(self, clock: int, time: float, received: float, *, is_reported: bool) -> float:
        """Process a reading of the clock, and return the lead that it shows without steering [s].

        time: when the request arrives at the earliest [s]; received: when the reply came [s].
        is_reported: whether a jump is a problem, since no restart of the amplifier can explain it.
        """
        readings = self._readings
        # The difference is negative if the bits take less time than they should.
        max_delay = abs(received - self._arrives_at)
        shown_lead = clock * CLOCK_STEP - time
        expected = readings.fit.on_line(time)
        off = math.remainder(self._steered.subtract_from(shown_lead, time) - expected, CLOCK_TURN)
        lead = expected + off
        verdict = readings.judge(
            off,
            time,
            max_early=time - self._sent_at,
            max_delay=max_delay,
            error=self._fit_error(time),
            clock_error=self._max_reading_error,
        )
        match verdict:
            case ReadingVerdict.DOUBTFUL:
                return lead
            case ReadingVerdict.JUMPED:
                if is_reported:
                    self._jumped_at = time
                self._forget(time)
                lead = math.remainder(shown_lead, CLOCK_TURN)
            case ReadingVerdict.BELOW_FIT:
                readings.lower(off)
        readings.add(Reading(time, lead, max_delay))
        return lead
