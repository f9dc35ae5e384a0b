"""Format the daemon's status and events for display."""

from collections.abc import Mapping
from datetime import datetime
from typing import Any

from controller.api.link import Notification
from controller.api.methods import StatusResult
from controller.api.schema import (
    AmplifierStatus,
    ContactStatus,
    headline,
)
from drivers.by_hand.cli import in_words
from drivers.protocol.definition import READINGS
from model.quantities import counted


def show_event(event: Notification, *, ahead: float, threshold: str | None) -> str:
    """Format an event.

    ahead: offset of the wall clock to the daemon's [s]; threshold: the rig's set, if known.
    """
    labels = {"foreign_level_db_sl": "foreign_level_db_sl (most sensitive threshold set)"}
    if threshold is not None:
        labels["rig_foreign_level_db_sl"] = f"rig_foreign_level_db_sl ({threshold})"
    at = datetime.fromtimestamp(event.time + ahead).isoformat(timespec="milliseconds")[11:]
    line = f"{at}  {event.topic:10s} {in_words(_relabeled(event.data, labels))}"
    if event.lost:
        line += f"  ({event.lost} lost)"
    return line


def _relabeled(value: Any, labels: Mapping[str, str]) -> Any:
    """Return a JSON value with labels in place of some of its keys, at any depth."""
    if isinstance(value, list):
        return [_relabeled(item, labels) for item in value]
    if not isinstance(value, Mapping):
        return value
    relabeled = {}
    for key, item in value.items():
        relabeled[labels.get(key, key)] = _relabeled(item, labels)
    return relabeled


def show_status(status: StatusResult) -> str:
    """Format a status."""
    lines = []
    for touch_input in status.inputs:
        if touch_input.problem:
            lines.append(f"touch {touch_input.name}: {touch_input.state}: {touch_input.problem}")
    lines.append(headline(status.state, status.cause))
    lines += _operation_lines(status)
    for contact in status.contacts:
        lines.append(_contact_line(contact))
    lines += _playback_lines(status)
    for amplifier in status.amplifiers:
        lines.append(_amplifier_line(amplifier))
        for report in amplifier.reports:
            lines.append(f"    {report.cause}; {report.remedy}")
    lines += _statistics_lines(status)
    lines.append(f"  state {status.state}, up for {status.uptime_s:.0f} s")
    return "\n".join(lines)


def _operation_lines(status: StatusResult) -> list[str]:
    """Format remedy, loss, lease, layout and threshold set."""
    lines = []
    if status.remedy is not None:
        lines.append(f"  remedy: {status.remedy}")
    if status.lost_for_s is not None:
        lines.append(f"  {_loss(status, status.lost_for_s)}")
    if status.slow_reason is not None:
        lines.append(f"  slow: {status.slow_reason}")
    if status.lease_left_s is not None:
        lines.append(f"  armed by {status.armed_by}, {status.lease_left_s:.1f} s left")
    if status.layout is not None:
        lines.append(f"  layout {_layout(status)}")
    scale = _scale(status)
    if scale is not None:
        lines.append(f"  {scale}")
    return lines


def _loss(status: StatusResult, lost_for_s: float) -> str:
    """Return the state to assume of lost amplifiers."""
    watchdog = f"its watchdog silences it after {status.watchdog_s:g} s without heartbeats"
    if not status.assume_energised:
        return f"unreachable for {lost_for_s:.1f} s: {watchdog}, unconfirmed"
    for amplifier in status.amplifiers:
        silence = amplifier.silence
        if silence and silence.silence == "may_play" and silence.may_play_for_s is None:
            watchdog = "it has no known watchdog: switch it off"
    return f"ASSUME ENERGIZED: a lost amplifier may still be playing; {watchdog}"


def _layout(status: StatusResult) -> str:
    """Return the current layout, and all layouts if there are several."""
    if len(status.layouts) > 1:
        return f"{status.layout} (of {', '.join(status.layouts)})"
    return str(status.layout)


def _scale(status: StatusResult) -> str | None:
    """Name the threshold set of the displayed levels; None without levels."""
    from model.finger import scale_in_words

    if status.threshold is None:  # an older daemon
        return None
    for contact in status.contacts:
        if contact.level_db_sl is not None or contact.rig_foreign_level_db_sl is not None:
            return scale_in_words(status.threshold)
    return None


def _contact_line(contact: ContactStatus) -> str:
    """Format a finger and its sensation."""
    from model.answer.answer import OWN, verdict_shown

    line = (
        f"  finger {contact.source} {contact.id} at {contact.x_m:.3f}, {contact.y_m:.3f} m: "
        f"{contact.role or 'not driven'}"
    )
    if contact.promised_level_db_sl is not None:
        line += f" at least {contact.promised_level_db_sl:.1f} dB SL"
    elif contact.level_db_sl is not None:
        line += f" {contact.level_db_sl:.1f} dB SL"
    if contact.promised_contrast_db is not None:
        line += f", at least {contact.promised_contrast_db:.1f} dB over the others"
    if contact.frequency_hz is not None:
        line += f", {contact.frequency_hz:g} Hz"
    if contact.effect is not None:
        line += f", effect {contact.effect}"
    if contact.feels is not None and contact.feels != contact.effect:
        line += f", feels {contact.feels}"
    if contact.rig_foreign_level_db_sl is not None:
        line += f", others at most {contact.rig_foreign_level_db_sl:.1f} dB SL"
    verdict = verdict_shown(contact.verdict, is_foreign_felt=contact.is_foreign_felt)
    if verdict is not None and verdict != OWN:
        line += f", {verdict}"
    if contact.held_back is not None:
        line += f": {contact.held_back}"
    if contact.load != 1:
        line += f", load {contact.load:.1f}"
    return line


def _playback_lines(status: StatusResult) -> list[str]:
    """Format strengths, the reason for silence, and the tones of all layers."""
    lines = []
    for name, gain_db in status.strengths.items():
        if gain_db:
            lines.append(f"  strength {name}: {gain_db:g} dB")
    if status.contacts and status.silence_reason is not None:
        lines.append(f"  silent: {status.silence_reason}")
    for drive in status.layers.values():
        for era, tone in drive.items():
            lines.append(
                f"  ERA {era}: {tone.frequency_hz:g} Hz, level {tone.level:.3f}, "
                f"{tone.phase_deg:g} deg"
            )
    return lines


def _amplifier_line(amplifier: AmplifierStatus) -> str:
    """Format an amplifier's last status."""
    details = []
    if amplifier.state is not None:
        details.append(amplifier.state)
    if amplifier.degraded:
        details.append("does not reply")
    if amplifier.lost:
        details.append("LOST")
    if amplifier.closed_with_lost:
        details.append("closed because another was lost")
    if amplifier.silence is not None:
        details.append(amplifier.silence.words)
    if amplifier.fault not in (None, "NONE"):
        details.append(f"fault {amplifier.fault}")
    for reading in READINGS:
        value = getattr(amplifier, reading.key)
        if value is not None and "status" in reading.views:
            figure = f"{reading.label} {value:.{reading.decimals}f} {reading.quantity.unit}"
            details.append(figure.rstrip())
    if amplifier.reply_age_s is None:
        details.append("no reply yet")
    else:
        details.append(f"last reply {amplifier.reply_age_s:.2f} s ago")
    return f"  amplifier {amplifier.name} ({amplifier.url}): {', '.join(details)}"


def _statistics_lines(status: StatusResult) -> list[str]:
    """Format latencies, and counts of rejected and lost data."""
    lines = []
    latency = status.latency_ms
    if latency.median is not None:
        lines.append(
            f"  latency of {counted(latency.count, 'touch', plural='touches')}: "
            f"median {latency.median:.2f} ms, 99 % {latency.p99:.2f} ms, "
            f"99.9 % {latency.p999:.2f} ms"
        )
    for reason, count in status.rejected_touches.items():
        line = f"  rejected touches, {reason.replace('_', ' ')}: {count}"
        example = status.rejected_examples.get(reason)
        if example:
            line += f" ({example})"
        lines.append(line)
    if status.clicks_too_late:
        lines.append(f"  clicks that came too late: {status.clicks_too_late}")
    lost_events = sum(status.lost_events.values())
    if lost_events:
        lines.append(f"  lost events: {lost_events}")
    return lines
