"""Reports in statuses: conditions of an amplifier that are not faults, with cause and remedy."""

from collections.abc import Sequence
from typing import Literal

from drivers.host.clock import CLOCK_SETTLING, ClockProblem
from drivers.host.clock_steering import MAX_CLOCK_RATE
from drivers.protocol.definition import QUANTITIES, STATUS_FLAGS
from drivers.protocol.records import Values

REPORT_LIFE = 10.0
"""Time for which a report is shown after the last status with it [s]."""
_HOT = 70.0  # °C; a hotter amplifier is reported, and stops itself with a fault if necessary
_PER_DEGREE = QUANTITIES["temperature"].per_unit
_LIMITED = 1 << STATUS_FLAGS["limited"]
_OPEN = 1 << STATUS_FLAGS["interlock_open"]

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
"""Cause and remedy of each kind of report."""


def reports_of(status: Values, clock_problem: ClockProblem | None = None) -> Sequence[ReportKind]:
    """Return the kinds of reports of a status, with the problem of the amplifier's clock.

    Makes few calls, because it runs with every heartbeat.
    """
    kinds: list[ReportKind] = [] if clock_problem is None else [clock_problem]
    if status["flags"] & _LIMITED:
        kinds.append("limited")
    if status["flags"] & _OPEN:
        kinds.append("interlock_open")
    if status["temperature"] > _HOT * _PER_DEGREE:
        kinds.append("hot")
    return kinds
