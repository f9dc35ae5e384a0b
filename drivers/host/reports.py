"""What an amplifier reports of itself, for its user, and what contradicts its requests."""

from collections.abc import Iterable
from typing import Literal

from drivers.protocol.records import Values
from drivers.protocol.table import FAULTS, QUANTITIES, has_flag, name_of

_HOT = 70.0  # °C, above which it is said; one that must not go on reports a fault
REPORT_LIFE = 10.0
"""For how long [s] a report is shown after the last status that had it."""

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


def reports_of(status: Values) -> Iterable[ReportKind]:
    """Return the kinds of reports of a status."""
    shown = {
        "limited": has_flag(status, "limited"),
        "interlock_open": has_flag(status, "interlock_open"),
        "hot": QUANTITIES["temperature"].from_wire(status["temperature"]) > _HOT,
    }
    return [kind for kind in REPORTS if shown[kind]]


def armed_problem(status: Values, latch: int | None) -> str | None:
    """Describe what no armed amplifier may report; None if nothing.

    latch: that of the reply to Arm, None before: a stop or fault since would have disarmed it.
    """
    if not has_flag(status, "high_voltage"):
        return "high voltage must be on, got off"
    if has_flag(status, "interlock_open"):
        return "interlock must be closed while armed, got open"
    if status["fault"]:
        return f"fault must be NONE while armed, got {name_of(FAULTS, status['fault'])}"
    if latch not in (None, status["latch"]):
        return f"latch must be {latch} since it was armed, got {status['latch']}"
    return None
