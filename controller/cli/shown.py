"""Status and events of the daemon, as commands show them to people."""

from datetime import datetime

from controller.api.client_protocol import Notification
from controller.api.methods import StatusResult
from controller.api.schema import LearningSummary, headline
from drivers.by_hand.cli import in_words
from model.counting import counted


def show_event(event: Notification, *, ahead: float) -> str:
    """Format an event; ahead: offset of the wall clock to the daemon's [s]."""
    at = datetime.fromtimestamp(event.time + ahead).isoformat(timespec="milliseconds")[11:]
    lost = f"  ({event.lost} lost)" if event.lost else ""
    return f"{at}  {event.topic:10s} {in_words(event.data)}{lost}"


def _show_learning(learning: LearningSummary) -> list[str]:
    """Format what is learned of the plate."""
    state = learning.state.replace("_", " ")
    lines = [f"  plate {state.upper() if learning.robust else state}: {learning.cause}"]
    if learning.robust:
        lines.append("    answers promise what a plate that is not known gives")
    if learning.remedy:
        lines.append(f"    remedy: {learning.remedy}")
    if learning.readings:
        last = learning.last_estimate_s
        ago = "" if last is None else f", last estimated {last:.0f} s ago"
        took = learning.latency_ms.median
        within = "" if took is None else f", median {took:.0f} ms after a measurement"
        lines.append(
            f"    {counted(learning.readings, 'pattern')} measured{ago}; "
            f"{counted(learning.corrections, 'correction')} of answers{within}"
        )
    return lines


def show_status(status: StatusResult) -> str:
    """Format a status."""
    lines = [headline(status.state, status.cause)]
    if status.remedy:
        lines.append(f"  remedy: {status.remedy}")
    if status.lost_for_s is not None:
        watchdog = (
            "one without a watchdog plays on until it is switched off"
            if status.watchdog_s is None
            else f"its watchdog silences it after {status.watchdog_s:g} s without heartbeats"
        )
        lines.append(
            f"  ASSUME ENERGISED: a lost amplifier may still be playing; {watchdog}"
            if status.assume_energised
            else f"  unreachable for {status.lost_for_s:.1f} s: {watchdog}, unconfirmed"
        )
    if status.armed_by is not None and status.lease_left_s is not None:
        lines.append(f"  armed by {status.armed_by}, {status.lease_left_s:.1f} s left")
    for contact in status.contacts:
        level = "" if contact.level_db_sl is None else f" {contact.level_db_sl:.1f} dB SL"
        promised = contact.robust_felt_contrast_db
        contrast = "" if promised is None else f", at least {promised:.1f} dB over the others"
        effect = "" if contact.effect is None else f", effect {contact.effect}"
        if contact.feels not in (None, contact.effect):
            effect += f", feels {contact.feels}"
        others = contact.foreign_level_db_sl
        effect += "" if others is None else f", others at most {others:.1f} dB SL"
        verdict = "" if contact.verdict in (None, "own") else f", {contact.verdict}"
        held_back = verdict if contact.held_back is None else f"{verdict}: {contact.held_back}"
        load = "" if contact.load == 1 else f", load {contact.load:.1f}"
        lines.append(
            f"  finger {contact.source} {contact.id} at {contact.x_m:.3f}, {contact.y_m:.3f} m: "
            f"{contact.role or 'not driven'}{level}{contrast}{effect}{held_back}{load}"
        )
    if status.silence_reason is not None and status.contacts:
        lines.append(f"  silent: {status.silence_reason}")
    elif status.contacts and status.state == "READY_TO_SWITCH_ON":
        lines.append("  silent: not armed; arm with era arm")
    if status.learning is not None:
        lines += _show_learning(status.learning)
    for era, tone in status.drive.items():
        lines.append(
            f"  ERA {era}: {tone.frequency_hz:g} Hz, level {tone.level:.3f}, {tone.phase_deg:g} deg"
        )
    for amplifier in status.amplifiers:
        parts = [amplifier.state] if amplifier.state else []
        if amplifier.degraded:
            parts.append("does not reply, may play")
        if amplifier.lost:
            parts.append("LOST")
        if amplifier.closed_with_lost:
            parts.append("closed because another was lost")
        if amplifier.fault not in (None, "NONE"):
            parts.append(f"fault {amplifier.fault}")
        if amplifier.temperature_c is not None:
            parts.append(f"{amplifier.temperature_c:.1f} degC")
        if amplifier.reply_age_s is not None:
            parts.append(f"last reply {amplifier.reply_age_s:.2f} s ago")
        else:
            parts.append("no reply yet")
        lines.append(f"  amplifier {amplifier.name} ({amplifier.url}): {', '.join(parts)}")
    latency = status.latency_ms
    if latency.median is not None:
        lines.append(
            f"  latency of {counted(latency.count, 'command')}: median {latency.median:.2f} ms, "
            f"99 % {latency.p99:.2f} ms, 99.9 % {latency.p999:.2f} ms"
        )
    for reason, count in status.rejected_touches.items():
        lines.append(f"  rejected touches, {reason.replace('_', ' ')}: {count}")
    lines.append(f"  state {status.state}, up for {status.uptime_s:.0f} s")
    return "\n".join(lines)
