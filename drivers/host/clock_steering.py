"""Steering of an amplifier's clock: the shift and the rates sent to it, and their effect.

The shift is sent with Arm, to the nearest step of 305 us. The rate is sent with each Ping: it
cancels the rate of the crystal and leads the remaining lead to zero, fast while nothing plays, and
otherwise too slowly to be felt.

A confirmed rate adds rate * t to the clock's lead at time t, and a change of the rate keeps the
lead at the moment of the change. So all shifts and rates have together added

    steered_lead(t) = offset + rate * t
"""

from typing import NamedTuple

from drivers.protocol.definition import HIGH_TIME, HIGH_WORDS, QUANTITIES

MAX_CLOCK_RATE = 2e-4
"""Largest rate of a crystal against the host's; a faster or slower one is broken."""
_PER_RATE = QUANTITIES["rate"].per_unit


class _SteeringLimit(NamedTuple):
    """How fast a lead is steered to zero."""

    time: float
    """Time in which it is steered to zero [s], unless the rate would be too high."""
    max_rate: float
    """Highest rate."""

    def rate(self, lead: float) -> float:
        """Return the rate that steers a lead [s] to zero."""
        return -_limited(lead / self.time, self.max_rate)


_GENTLE = _SteeringLimit(0.5, 1e-4)
"""While something plays: the rate is not felt."""
_FAST = _SteeringLimit(0.2, 2.8e-3)
"""While nothing plays: four Pings, since lost ones would overshoot; the highest rate of a Ping."""
_COMMON = _SteeringLimit(0.5, 5e-4)
"""For the lead that all clocks of a line share. Their Pings are sequential: with a higher rate the
clocks would diverge."""
MAX_COMMON_RATE = _COMMON.max_rate
"""Highest rate at which the common lead is steered to zero."""


def shift_against(lead: float) -> int:
    """Return the shift of an Arm that cancels a lead [s], in units of the wire."""
    return round(-lead / HIGH_TIME) % HIGH_WORDS


def rate_against(
    own_lead: float, common_lead: float, crystal_rate: float, *, is_gentle: bool
) -> int:
    """Return the rate of a Ping that steers a clock, in units of the wire.

    own_lead: its lead [s] over the clock that it follows; common_lead: lead [s] of that clock over
    the host's. crystal_rate: rate of its crystal, which is cancelled. is_gentle: whether the rate
    must not be felt.
    """
    limit = _GENTLE if is_gentle else _FAST
    steering = _COMMON.rate(common_lead) + limit.rate(own_lead)
    crystal = _limited(crystal_rate, MAX_CLOCK_RATE)
    return round((_limited(steering, _FAST.max_rate) - crystal) * _PER_RATE)


class _SentPings(NamedTuple):
    """Pings that have no reply yet."""

    first_arrives_at: float
    """In s, at the earliest."""
    last_arrives_at: float
    """In s, at the earliest."""


class SteeredLead:
    """The lead that shifts and rates have added to a clock, see the equation of this module."""

    _offset: float = 0.0
    """In s."""
    _rate: float = 0.0
    """Rate of the last confirmed Ping [s/s]."""
    _sent_pings: _SentPings | None = None
    """Pings without reply, if any: the clock may have obeyed only some."""
    _sent_shift: int = 0
    """The shift of an Arm that has no reply yet."""

    def restart(self, time: float) -> None:
        """Count the steered lead from zero at a time [s]."""
        self._offset = -self._rate * time

    def add_to(self, lead: float, time: float) -> float:
        """Return a lead [s] at a time [s] with the steered lead."""
        return lead + self._offset + self._rate * time

    def subtract_from(self, lead: float, time: float) -> float:
        """Return a lead [s] at a time [s] without the steered lead."""
        return lead - self._offset - self._rate * time

    @property
    def is_rate_known(self) -> bool:
        """Whether every Ping has a reply, so that the present rate is known."""
        return self._sent_pings is None

    def note_shift_sent(self, shift: int) -> None:
        """Note the shift of an Arm that is sent now."""
        self._sent_shift = shift

    def note_ping_sent(self, arrives_at: float) -> None:
        """Note a Ping that is sent now and arrives at a time [s] at the earliest."""
        sent_pings = self._sent_pings
        first_arrives_at = arrives_at if sent_pings is None else sent_pings.first_arrives_at
        self._sent_pings = _SentPings(first_arrives_at, arrives_at)

    def take_sent_shift(self) -> int:
        """Return the shift of an Arm without a reply, which is then forgotten; 0 without one."""
        shift = self._sent_shift
        self._sent_shift = 0
        return shift

    def note_shift(self, shift: int) -> None:
        """Note a shift that a status confirms."""
        self._offset += shift * HIGH_TIME

    def note_rate(self, wire_rate: int, time: float) -> None:
        """Note the rate of a Ping that a status at a time [s] confirms; 0 for a disarmed clock."""
        rate = wire_rate / _PER_RATE
        since = time
        if self._sent_pings is not None:  # any Ping may be the first to arrive
            since = (self._sent_pings.first_arrives_at + self._sent_pings.last_arrives_at) / 2
        self._offset += (self._rate - rate) * since
        self._rate = rate
        self._sent_pings = None


def _limited(value: float, limit: float) -> float:
    """Return a value, or the nearest one from -limit to limit."""
    return min(max(value, -limit), limit)
