"""What an amplifier reports of itself, for its user, and what contradicts its requests."""

from collections.abc import Sequence
from typing import Literal

from drivers.protocol.records import Values
from drivers.protocol.table import FAULTS, QUANTITIES, STATUS_FLAGS, name_of

_HOT = 70.0  # °C, above which it is said; one that must not go on reports a fault
REPORT_LIFE = 10.0
"""For how long [s] a report is shown after the last status that had it."""
_PER_DEGREE = QUANTITIES["temperature"].per_unit
_LIMITED, _OPEN = 1 << STATUS_FLAGS["limited"], 1 << STATUS_FLAGS["interlock_open"]
_HIGH_VOLTAGE = 1 << STATUS_FLAGS["high_voltage"]

ReportKind = Literal["limited", "interlock_open", "hot"]

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
}
"""Cause and remedy of the reports of a status that are no fault, by kind."""


def reports_of(status: Values) -> Sequence[ReportKind]:
    """Return the kinds of reports of a status; few calls, since every heartbeat has one."""
    kinds: list[ReportKind] = []
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
