"""Statuses of an amplifier: contradictions to the requests sent to it, and reports in them.

A single contradiction may be a moment between two sets; several in a row are a fault. A report is a
condition of the amplifier that is no fault, with its cause and remedy.
"""

import math
from collections.abc import Sequence
from typing import Literal

from drivers.errors import CommandRefused
from drivers.host.clock import CLOCK_SETTLING, ClockProblem, HeldClock
from drivers.host.clock_steering import MAX_CLOCK_RATE
from drivers.host.ledger import Ledger
from drivers.host.watchdog import Feeding
from drivers.protocol.definition import FAULTS, MAX_AHEAD, QUANTITIES, STATUS_FLAGS, name_of
from drivers.protocol.records import Values

MAX_CONTRADICTIONS = 2
"""So many contradictions in a row are a fault."""
MAX_START_ERROR = 0.003
"""If a start is known worse than this [s], statuses are not compared."""
_SAME_MOMENT = 0.01  # s; contradictions of statuses closer to each other than this count once
_LEFT = QUANTITIES["watchdog_left"]
REPORT_LIFE = 10.0
"""Time for which a report is shown after the last status with it [s]."""
_HOT = 70.0  # °C; a hotter amplifier is reported, and stops itself with a fault if necessary
_PER_DEGREE = QUANTITIES["temperature"].per_unit
_LIMITED = 1 << STATUS_FLAGS["limited"]
_OPEN = 1 << STATUS_FLAGS["interlock_open"]
_HIGH_VOLTAGE = 1 << STATUS_FLAGS["high_voltage"]

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


class StatusContradictions:
    """Compares the statuses of an armed amplifier, and counts contradictions in a row.

    name: of the amplifier, for messages.
    """

    count: int = 0
    """Number of contradictory statuses in a row."""
    _last_at: float = -math.inf
    """When the last contradictory status came [s]."""
    _was_unfed: bool = False
    """Whether the last contradiction was in a status that does not feed."""
    _misachieved: int = 0
    """Number of contradictory achieved layers in a row."""
    _armed_latch: int | None = None
    """Latch in the reply to the last Arm."""
    _may_wait_until: float = -math.inf
    """Latest start of the last set with a poor clock [s]."""
    _is_start_known: bool = True
    """Whether that start is known well enough to compare statuses."""

    def __init__(self, name: str) -> None:
        self._name = name

    def restart(self, latch: int) -> None:
        """Count from zero again, because the amplifier was armed; latch: in the reply."""
        self.count = 0
        self._misachieved = 0
        self._armed_latch = latch

    def note_commit(self, now: float, start_error: float) -> None:
        """Note a commit that is sent now; start_error: error of its start [s]."""
        self._is_start_known = start_error <= MAX_START_ERROR
        self._may_wait_until = now + MAX_AHEAD

    def note_immediate_start(self) -> None:
        """Note a set that starts when it arrives."""
        self._may_wait_until = -math.inf

    def compare(
        self,
        status: Values,
        sent_at: float,
        now: float,
        *,
        is_fed: bool,
        ledger: Ledger,
        feeding: Feeding,
        clock: HeldClock,
    ) -> None:
        """Compare a status, received now, with the requests sent before it.

        sent_at: when the request for it went out [s]. is_fed: whether that request feeds the
        watchdog. Raises CommandRefused for the second contradiction in a row.
        """
        problem = armed_problem(status, self._armed_latch)
        if problem is None and not is_fed:
            left = status["watchdog_left"] / _LEFT.per_unit
            problem = feeding.problem(left, sent_at, now)
        if problem is None:
            problem = ledger.problem_of(status, sent_at, now)
            if problem is not None and self._may_wait(sent_at, now, clock):
                problem = None
        if problem is None:
            # The reply to a request that feeds does not show how the watchdog runs down.
            self._note_agreement(shows_watchdog=not is_fed and feeding.is_shown_by(sent_at))
        elif self._is_fault(now, is_fed=is_fed):
            raise contradicted(self._name, problem)

    def _may_wait(self, sent_at: float, now: float, clock: HeldClock) -> bool:
        """Whether the last set may wait although it was committed: its clock is not synchronized.

        sent_at: when the request for the status went out [s].
        """
        is_start_sure = self._is_start_known and clock.is_synchronized(now)
        return sent_at < self._may_wait_until and not is_start_sure

    def _note_agreement(self, *, shows_watchdog: bool) -> None:
        """Note a status without contradiction, which ends the row.

        shows_watchdog: whether the status shows how the watchdog runs down. Only such a status ends
        a row whose last contradiction was in a status that does not feed.
        """
        if shows_watchdog or not self._was_unfed:
            self.count = 0
            self._last_at = -math.inf

    def _is_fault(self, now: float, *, is_fed: bool) -> bool:
        """Count a contradictory status that came now [s]; return whether the row is a fault."""
        self._was_unfed = not is_fed
        if now - self._last_at < _SAME_MOMENT:
            return False
        self.count += 1
        self._last_at = now
        return self.count >= MAX_CONTRADICTIONS

    def note_achieved(self, problem: str | None) -> None:
        """Note how an amplifier has achieved a layer; problem: the contradiction, if any.

        Raises CommandRefused for the second contradictory set in a row.
        """
        if problem is None:
            self._misachieved = 0
            return
        self._misachieved += 1
        if self._misachieved >= MAX_CONTRADICTIONS:
            raise contradicted(self._name, problem)


def contradicted(name: str, problem: str) -> CommandRefused:
    """Return the error of an amplifier that contradicts its requests again and again."""
    return CommandRefused(
        f"amplifier {name} contradicts its requests: {problem}; look for a derated or broken "
        "channel, an exchanged cable or firmware, then clear and arm again"
    )


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
