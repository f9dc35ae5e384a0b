"""Describe the amplifiers as messages of the API, from their last replies."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from controller.api.schema import (
    AmplifierReport,
    AmplifierSilence,
    AmplifierStatus,
    LinkCounters,
)
from controller.daemon.plate_view import in_milliseconds
from controller.operation.operation_states import Loss
from drivers.by_hand.rows import silence_rows
from drivers.host.amplifier import Amplifier
from drivers.host.members import is_lost
from drivers.host.requests import LinkStatistics
from drivers.host.statuses import REPORT_LIFE, REPORTS, ReportKind
from drivers.host.stops import StopOutcome
from drivers.protocol.definition import FAULTS, QUANTITIES, READINGS, STATES, has_flag, name_of
from drivers.protocol.records import Values
from registry import threads

_LEVEL = QUANTITIES["level"]


def amplifier_statuses(
    amplifiers: Mapping[str, Amplifier],
    urls: Mapping[str, str],
    *,
    are_open: bool,
    lost: Loss | None,
    what_may_play: Callable[[str], StopOutcome],
    clock_errors: Mapping[str, float],
    targets: Sequence[str] = (),
) -> list[AmplifierStatus]:
    """Describe all amplifiers from their last statuses, without sending a request.

    are_open: whether all are open together; otherwise their last statuses are outdated.
    lost: the loss after which the other amplifiers were closed.
    what_may_play: returns the possible output of an amplifier that does not reply, by name.
    clock_errors: RMS errors of the clocks [s]; see `Group`.
    targets: the fingers that currently feel something.
    """
    now = threads.now()
    statuses = []
    for name, url in urls.items():
        amplifier = amplifiers.get(name)
        status: Values | None = None
        is_degraded = False
        if amplifier is not None and are_open and not is_lost(amplifier):
            status = amplifier.status
            is_degraded = amplifier.no_reply_cause is not None
        has_status = status is not None
        is_closed_with_lost = lost is not None and bool(lost.names) and name not in lost.names
        silence: AmplifierSilence | None = None
        if not has_status or is_degraded:
            silence = AmplifierSilence(**silence_rows(what_may_play(name), now))
        clock_skew_us: float | None = None
        clock_error = clock_errors.get(name, math.inf)
        if has_status and len(urls) > 1 and math.isfinite(clock_error):
            clock_skew_us = 1e6 * clock_error
        statuses.append(
            AmplifierStatus(
                name=name,
                url=url,
                clock_skew_us=clock_skew_us,
                degraded=is_degraded,
                lost=not has_status and not is_closed_with_lost,
                closed_with_lost=not has_status and is_closed_with_lost,
                silence=silence,
                **_readings(status),
                **_history(amplifier, targets, now),
            )
        )
    return statuses


def _readings(status: Values | None) -> dict[str, Any]:
    """Return the state and readings of an amplifier's status, by API key."""
    readings: dict[str, Any] = {"state": None, "fault": None, "levels": [], "high_voltage": None}
    for reading in READINGS:
        readings[reading.key] = None
    if status is None:
        return readings
    readings["state"] = name_of(STATES, status["state"])
    readings["fault"] = name_of(FAULTS, status["fault"])
    readings["levels"] = [_LEVEL.from_wire(level) for level in status["levels"]]
    readings["high_voltage"] = has_flag(status, "high_voltage")
    for reading in READINGS:
        readings[reading.key] = reading.in_unit(status)
    return readings


def _history(amplifier: Amplifier | None, targets: Sequence[str], now: float) -> dict[str, Any]:
    """Return identity, reports and statistics of an amplifier, by API key."""
    serial_number: str | None = None
    reply_age: float | None = None
    reports = []
    statistics = LinkStatistics()
    if amplifier is not None:
        serial_number = amplifier.identity.get("serial_number")
        statistics = amplifier.statistics
        if amplifier.status_at is not None:
            reply_age = max(0.0, now - amplifier.status_at)
        for kind, reported_at in amplifier.reported_at.items():
            if reported_at > now - REPORT_LIFE:
                reports.append(_report(kind, targets))
    counts = {**vars(statistics), "round_trip_ms": in_milliseconds(statistics.last_round_trip)}
    return {
        "serial_number": serial_number,
        "reply_age_s": reply_age,
        "reports": reports,
        "statistics": LinkCounters.model_validate(counts, extra="ignore"),
    }


def _report(kind: ReportKind, targets: Sequence[str]) -> AmplifierReport:
    """Describe a report of an amplifier.

    Limited levels are felt by every target, so the cause names all targets.
    """
    cause, remedy = REPORTS[kind]
    if kind == "limited" and targets:
        cause += f", and fingers feel less than promised: {', '.join(targets)}"
    return AmplifierReport(kind=kind, cause=cause, remedy=remedy)
