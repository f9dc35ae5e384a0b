"""What an amplifier reports of itself, for its user, and what contradicts its requests."""

from collections.abc import Sequence
from typing import Literal

from drivers.protocol.definition import FAULTS, QUANTITIES, STATUS_FLAGS, name_of
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
