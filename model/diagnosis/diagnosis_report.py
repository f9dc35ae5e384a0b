"""Report of a diagnosis, as text and as JSON."""

from collections.abc import Sequence
from typing import Any

from model.diagnosis.causes import Explanation
from model.diagnosis.plate_match import FITS
from model.diagnosis.polarity import EVEN
from model.diagnosis.verdict import UNLIKELY, ChannelState, ChannelVerdict, Verdict
from model.quantities import in_display_unit, percent

_TO_DO: dict[ChannelState, str] = {
    "dead": "check its supply, its cable and the amplifier's channel",
    "weak": "check its voltage and mounting, or measure its gain with `era calibrate`",
    "strong": "lower its voltage, or correct its stroke in the rig",
    "inverted": "swap its two wires",
    "out of phase": "measure its gains with `era calibrate`",
}
_MIN_SHARE = 0.05  # likelihood of a reported explanation


def verdict_rows(verdict: Verdict) -> list[str]:
    """Lines of findings with their remedies; one line if there are none."""
    rows = []
    for cycle in verdict.swapped:
        if len(cycle) == 2:
            one, other = (_at(_of(verdict, era)) for era in cycle)
            rows.append(
                f"SWAPPED: {one} drives ERA {cycle[1]}, and {other} drives ERA {cycle[0]} "
                f"({_sure(verdict, cycle)}): exchange the two plugs, or the channels in the rig"
            )
        else:
            rows.append(
                f"SWAPPED in a cycle: the channels of {', '.join(cycle)} each drive the next "
                f"one's ERA ({_sure(verdict, cycle)}): correct the plugs"
            )
    swapped = {era for cycle in verdict.swapped for era in cycle}
    for channel in verdict.channels:
        rows += [
            _row(channel, state) for state in channel.states if _is_news(state, channel, swapped)
        ]
    inverted = [c for c in verdict.channels if "inverted" in c.states]
    if len(inverted) > 1 and len(inverted) == sum(c.drives is not None for c in verdict.channels):
        rows.append("all of them: check mounting of sensors and sign convention of phases")
    rows += [f"SENSOR {name} {why}: left out" for name, why in verdict.bad_sensors]
    if not verdict.plate_matches:
        rows += plate_rows(verdict)
    return rows or ["ALL WELL: plate and channels match the rig"]


def plate_rows(verdict: Verdict) -> list[str]:
    """Lines on how the plate differs from the rig, and on possible explanations."""
    match = verdict.match
    if match is None:
        return []
    if match.error > FITS:
        why = f"{percent(match.error)} unexplained at best"
    else:
        at = int(abs(match.z).argmax())
        parameter = match.parameters[at].name
        why = f"{parameter} would be off by {abs(match.z[at]):.1f} standard deviations"
    rows = [f"PLATE: the rig does not match the plate: {why}"]
    good = [each for each in verdict.explanations if explains(each) and each.share >= _MIN_SHARE]
    for number, each in enumerate(good):
        unit = each.cause.unit
        rows.append(
            f"  {'or ' if number else ''}{each.cause.key} {in_display_unit(each.value, unit)} "
            f"instead of {in_display_unit(each.expected, unit)} would explain it: "
            f"{percent(each.match.error)} unexplained, likelihood {percent(each.share)}"
        )
    if good:
        rows.append(f"  correct {good[0].cause.key} in the rig, or the plate; then check again")
    else:
        rows.append(
            "  no single parameter of the rig would explain it: check plate, positions of sensors "
            "and ERAs, and measure for `era calibrate`"
        )
    return rows


def explains(explanation: Explanation) -> bool:
    """Whether the rest of the rig is then within its priors."""
    return explanation.match.error <= FITS and explanation.match.worst <= UNLIKELY


def channel_table(verdict: Verdict) -> list[str]:
    """Table of the channels with a header line."""
    rows = [f"{'ERA':8} {'channel':12} {'drives':8} {'gain':>6} {'phase':>7} {'alike':>6}  verdict"]
    for channel in verdict.channels:
        gain = "-" if channel.gain is None else f"{channel.gain:.2f}"
        phase = "-" if channel.phase is None else f"{channel.phase:+.0f}°"
        alike = "-" if channel.likeness_found is None else f"{channel.likeness_found:.3f}"
        rows.append(
            f"{channel.era:8} {channel.channel.amplifier + ':' + str(channel.channel.number):12} "
            f"{channel.drives or '-':8} {gain:>6} {phase:>7} {alike:>6}  "
            f"{', '.join(channel.states)}"
        )
    return rows


def as_json(verdict: Verdict) -> dict[str, Any]:
    """Verdict as JSON; units are in the keys."""
    match = verdict.match
    return {
        "all_well": verdict.is_well,
        "channels": [
            {
                "era": channel.era,
                "amplifier": channel.channel.amplifier,
                "channel": channel.channel.number,
                "states": list(channel.states),
                "drives": channel.drives,
                "gain": channel.gain,
                "phase_deg": channel.phase,
                "mac_of_the_rigs_era": channel.likeness_own,
                "mac_of_the_era_found": channel.likeness_found,
                "confidence": channel.confidence,
            }
            for channel in verdict.channels
        ],
        "swapped": [list(cycle) for cycle in verdict.swapped],
        "plate": {
            "matches": verdict.plate_matches,
            "unexplained": None if match is None else match.error,
            "farthest_standard_deviations": None if match is None else match.worst,
            "parameters": []
            if match is None
            else [
                {
                    "parameter": parameter.name,
                    "unit": parameter.unit,
                    "expected": parameter.prior,
                    "found": parameter.value(parameter.start + z * parameter.prior_std),
                    "standard_deviations": float(z),
                }
                for parameter, z in zip(match.parameters, match.z, strict=True)
            ],
            "explanations": [
                {
                    "key": each.cause.key,
                    "unit": each.cause.unit,
                    "expected": each.expected,
                    "found": each.value,
                    "explains": explains(each),
                    "likelihood": each.share,
                    "unexplained": each.match.error,
                }
                for each in verdict.explanations
            ],
        },
        "bad_sensors": [{"sensor": name, "problem": why} for name, why in verdict.bad_sensors],
        "sensor_count": verdict.sensor_count,
        "drive_frequencies_hz": verdict.frequencies.tolist(),
        "findings": verdict_rows(verdict),
    }


def _is_news(state: ChannelState, channel: ChannelVerdict, swapped: set[str]) -> bool:
    return state not in ("well", "not driven") and not (
        state == "other ERA" and channel.era in swapped
    )


def _row(channel: ChannelVerdict, state: ChannelState) -> str:
    at = _at(channel)
    match state:
        case "dead":
            return f"DEAD: {at} does not move the plate: {_TO_DO[state]}"
        case "other ERA":
            return (
                f"WRONG ERA: {at} drives ERA {channel.drives} instead of {channel.era} (MAC "
                f"{channel.likeness_found:.3f}, with its own ERA {channel.likeness_own:.3f}; "
                f"confidence {channel.confidence:.3f}): correct the plug, or the rig's channels"
            )
        case "weak" | "strong":
            return (
                f"{state.upper()}: {at} plays {channel.gain:.2f} of the commanded amplitude: "
                + (_TO_DO[state])
            )
        case "inverted":
            even = " (or the other half)" if channel.confidence <= EVEN else ""
            return f"INVERTED: {at} has the opposite sign of the others{even}: {_TO_DO[state]}"
        case _:
            return f"OUT OF PHASE: {at} is off by {channel.phase:+.0f}°: {_TO_DO['out of phase']}"


def _at(channel: ChannelVerdict) -> str:
    wired = channel.channel
    return f"channel {wired.number} of amplifier {wired.amplifier} (ERA {channel.era} in the rig)"


def _of(verdict: Verdict, era: str) -> ChannelVerdict:
    return next(channel for channel in verdict.channels if channel.era == era)


def _sure(verdict: Verdict, eras: Sequence[str]) -> str:
    return f"confidence {min(_of(verdict, era).confidence for era in eras):.3f}"
