"""Format the daemon's status and events for display."""

from datetime import datetime

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


def show_event(event: Notification, *, ahead: float) -> str:
    """Format an event; ahead: offset of the wall clock to the daemon's [s]."""
    at = datetime.fromtimestamp(event.time + ahead).isoformat(timespec="milliseconds")[11:]
    lost = f"  ({event.lost} lost)" if event.lost else ""
    return f"{at}  {event.topic:10s} {in_words(event.data)}{lost}"


def show_status(status: StatusResult) -> str:
    """Format a status."""
    left = status.lease_left_s
    armed = None if left is None else f"{status.armed_by}, {left:.1f} s left"
    lines = [
        *(
            f"touch {each.name}: {each.state}: {each.problem}"
            for each in status.inputs
            if each.problem
        ),
        headline(status.state, status.cause),
        *_given(("  remedy: {}", status.remedy), ("  {}", _loss(status))),
        *_given(("  slow: {}", status.slow_reason)),
        *_given(("  armed by {}", armed)),
        *_given(("  layout {}", status.layout and _layout(status))),
        *_given(("  {}", _scale(status))),
        *map(_contact, status.contacts),
        *[f"  strength {name}: {gain:g} dB" for name, gain in status.strengths.items() if gain],
        *_given(("  silent: {}", status.silence_reason if status.contacts else None)),
    ]
    lines += [
        f"  ERA {era}: {tone.frequency_hz:g} Hz, level {tone.level:.3f}, {tone.phase_deg:g} deg"
        for drive in status.layers.values()
        for era, tone in drive.items()
    ]
    for amplifier in status.amplifiers:
        reports = [f"    {each.cause}; {each.remedy}" for each in amplifier.reports]
        lines += [_amplifier(amplifier), *reports]
    latency = status.latency_ms
    if latency.median is not None:
        lines.append(
            f"  latency of {counted(latency.count, 'touch', plural='touches')}: "
            f"median {latency.median:.2f} ms, 99 % {latency.p99:.2f} ms, "
            f"99.9 % {latency.p999:.2f} ms"
        )
    for reason, count in status.rejected_touches.items():
        example = status.rejected_examples.get(reason)
        newest = f" ({example})" if example else ""
        lines.append(f"  rejected touches, {reason.replace('_', ' ')}: {count}{newest}")
    lines += _given(
        ("  clicks that came too late: {}", status.clicks_too_late or None),
        ("  lost events: {}", sum(status.lost_events.values()) or None),
    )
    return "\n".join([*lines, f"  state {status.state}, up for {status.uptime_s:.0f} s"])


def _scale(status: StatusResult) -> str | None:
    """Name the threshold set of the displayed levels; None without levels."""
    from model.finger import scale_in_words

    if status.threshold is None:  # an older daemon
        return None
    for contact in status.contacts:
        if contact.level_db_sl is not None or contact.rig_foreign_level_db_sl is not None:
            return scale_in_words(status.threshold)
    return None


def _layout(status: StatusResult) -> str:
    """Return the current layout, and all layouts if there are several."""
    others = f" (of {', '.join(status.layouts)})" if len(status.layouts) > 1 else ""
    return f"{status.layout}{others}"


def _given(*texts: tuple[str, object]) -> list[str]:
    """Format texts with their values; texts whose value is None or False are left out."""
    return [text.format(value) for text, value in texts if value is not None and value is not False]


def _loss(status: StatusResult) -> str | None:
    """Return the state to assume of lost amplifiers; None if none is lost."""
    if status.lost_for_s is None:
        return None
    watchdog = f"its watchdog silences it after {status.watchdog_s:g} s without heartbeats"
    if status.assume_energised:
        silences = [each.silence for each in status.amplifiers if each.silence is not None]
        if any(each.silence == "may_play" and each.may_play_for_s is None for each in silences):
            watchdog = "it has no known watchdog: switch it off"
        return f"ASSUME ENERGISED: a lost amplifier may still be playing; {watchdog}"
    return f"unreachable for {status.lost_for_s:.1f} s: {watchdog}, unconfirmed"


def _contact(contact: ContactStatus) -> str:
    """Format a finger and its sensation."""
    from model.answer.answer import OWN, verdict_shown

    verdict = verdict_shown(contact.verdict, is_foreign_felt=contact.is_foreign_felt)
    details = _given(
        (" {:.1f} dB SL", contact.level_db_sl),
        (", at least {:.1f} dB over the others", contact.promised_contrast_db),
        (", {:g} Hz", contact.frequency_hz),
        (", effect {}", contact.effect),
        (", feels {}", None if contact.feels == contact.effect else contact.feels),
        (", others at most {:.1f} dB SL", contact.rig_foreign_level_db_sl),
        (", {}", None if verdict == OWN else verdict),
        (": {}", contact.held_back),
        (", load {:.1f}", None if contact.load == 1 else contact.load),
    )
    return (
        f"  finger {contact.source} {contact.id} at {contact.x_m:.3f}, {contact.y_m:.3f} m: "
        f"{contact.role or 'not driven'}{''.join(details)}"
    )


def _amplifier(amplifier: AmplifierStatus) -> str:
    """Format an amplifier's last status."""
    details = _given(
        ("{}", amplifier.state),
        ("does not reply", amplifier.degraded),
        ("LOST", amplifier.lost),
        ("closed because another was lost", amplifier.closed_with_lost),
        ("{}", amplifier.silence and amplifier.silence.words),
        ("fault {}", None if amplifier.fault == "NONE" else amplifier.fault),
        *(
            (
                f"{each.label} {{:.{each.decimals}f}} {each.quantity.unit}".rstrip(),
                getattr(amplifier, each.key),
            )
            for each in READINGS
            if "status" in each.views
        ),
        ("last reply {:.2f} s ago", amplifier.reply_age_s),
        ("no reply yet", amplifier.reply_age_s is None),
    )
    return f"  amplifier {amplifier.name} ({amplifier.url}): {', '.join(details)}"
