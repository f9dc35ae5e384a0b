"""Report of a diagnosis, as text and as JSON."""

from collections.abc import Sequence
from typing import Any

from model.arrays import best_of
from model.estimate.causes import (
    BeyondTolerances,
    ExchangedSensors,
    Explanation,
    ReversedAxes,
    TurnedGrain,
)
from model.estimate.identify import value_rows
from model.estimate.plate_match import FALSE_ALARM, MAX_FIT_ERROR
from model.estimate.verdict import ChannelState, ChannelVerdict, MisreadResonance, Verdict
from model.quantities import counted, in_display_unit, percent
from model.structure.attachments import FingertipLoad, PointLoad
from model.study.verification import MIN_KEPT_SHARE

_REMEDIES: dict[ChannelState, str] = {
    "dead": "check its supply, its cable and the amplifier's channel",
    "loose": "press it on or glue it anew, and measure again",
    "weak": "check its voltage, volume and mounting, or measure its gain with `era calibrate`",
    "strong": "lower its voltage or volume, or correct its stroke or gains in the rig",
    "other ERA": "correct the plug, or the rig's channels",
    "inverted": "swap its two wires",
    "out of phase": "measure its gains with `era calibrate`",
}
_MIN_CHANGE = 0.03  # relative, of a reported value
_MIN_SHARE = 0.05  # likelihood of a reported explanation


def verdict_rows(verdict: Verdict) -> list[str]:
    """Lines of findings with their remedies, or one that all is well."""
    by_era = {channel.era: channel for channel in verdict.channels}
    rows = [f"{each.label}: {each}" for each in verdict.corrections]
    for cycle in verdict.swapped:
        confidence = f"(confidence {min(by_era[era].confidence for era in cycle):.3f})"
        if len(cycle) == 2:
            one, other = (_wiring(by_era[era]) for era in cycle)
            rows.append(
                f"SWAPPED: {one} drives ERA {cycle[1]}, and {other} drives ERA {cycle[0]} "
                f"{confidence}: exchange the two plugs, or the channels in the rig"
            )
        else:
            rows.append(
                f"SWAPPED in a cycle: the channels of {', '.join(cycle)} each drive the next "
                f"one's ERA {confidence}: correct the plugs"
            )
    swapped = {era for cycle in verdict.swapped for era in cycle}
    common = verdict.common_state
    if common is not None:
        rows.append(_common_row(verdict.channels, common))
    if verdict.all_inverted:
        rows.append(
            "INVERTED: all channels have the sign that is opposite to the sensors': turn the "
            "sensors over, swap the two wires of every ERA, or check the sign convention of phases"
        )
    for channel in verdict.channels:
        reported = {*channel.states} - {"well", "not driven", common}
        if verdict.all_inverted:
            reported.discard("inverted")
        if channel.era in swapped:
            reported.discard("other ERA")
        rows += [_row(channel, state) for state in channel.states if state in reported]
    rows += [f"SENSOR {each.name} {each.why}: left out" for each in verdict.bad_sensors]
    is_loose = any("loose" in channel.states for channel in verdict.channels)
    if verdict.is_of_another_rig:
        pass  # which is corrected first
    elif not verdict.plate_matches and not is_loose:
        rows += _plate_rows(verdict)
    elif verdict.match is not None and verdict.match.outliers.any():
        by_sensor = verdict.match.outliers.sum(axis=(0, 1))
        worst = best_of(by_sensor)
        rows.append(
            f"OUTLIERS: {counted(int(by_sensor.sum()), 'value')} left out, {by_sensor[worst]} of "
            f"them of sensor {verdict.sensors[worst]}: check for loose contacts if they are many"
        )
    if verdict.beyond is not None:
        rows += _beyond_rows(verdict.beyond)
    if verdict.misses_promises:
        rows.append(
            "PROMISE: half of the answers of the rig's table miss the contrast that it promises "
            f"by {verdict.missed_db:.1f} dB or more"
        )
    if not verdict.is_well or verdict.bad_sensors:
        return rows
    if difference_rows(verdict):
        well = "WIRING WELL: every channel that was driven drives its ERA as the rig says"
        return [*rows, well]
    return [*rows, "ALL WELL: plate and channels match the rig"]


def difference_rows(verdict: Verdict) -> list[str]:
    """Line on a plate that keeps too little of the rig's promises; empty if it keeps enough."""
    kept = verdict.kept_share
    if verdict.changes is None or kept is None or kept >= MIN_KEPT_SHARE:
        return []
    names = {"loss_factor": "loss factor", "stiffness": "ERA stiffness", "damping": "ERA damping"}
    changes = ", ".join(
        f"{names.get(kind, kind)} {100 * change:+.0f} %"
        for kind, change in verdict.changes.items()
        if abs(change) >= _MIN_CHANGE
    )
    within = "within tolerances, but not as written: " if verdict.plate_matches else ""
    if verdict.beyond is not None and not verdict.beyond.loads:
        within, changes = "", "by what has no name"
    return [
        f"PLATE DIFFERS: {within}{changes or 'single ERAs or bolts'}; it keeps "
        f"{percent(kept)} of what the rig's table promises: calibrate it with "
        "`era calibrate`"
    ]


def _beyond_rows(beyond: BeyondTolerances) -> list[str]:
    """Lines on loads of the plate, or one on another deviation beyond tolerances."""
    if beyond.loads:
        return [_load_row(load) for load in beyond.loads]
    if beyond.taper is not None:
        x, y = (f"{100 * each:+.1f} %" for each in beyond.taper)
        return [
            f"THICKNESS: the plate is {x} thicker at the end of x and {y} at that of y than in its "
            "middle, by what its sensors read: check it, or the sensors' scales"
        ]
    what = (
        f"{beyond.farthest} are off by {beyond.deviation:.1f} standard deviations of their "
        "tolerance"
        if beyond.deviation
        else f"{percent(beyond.error)} of the response is unexplained"
    )
    return [
        f"UNNAMED: the plate is as written, but for something that has no name here: {what}; "
        "check its thickness, what is bonded to it and the sensors' scales, and measure for "
        "`era calibrate`"
    ]


def _load_row(load: PointLoad | FingertipLoad) -> str:
    place = f"at ({load.x:.2f}, {load.y:.2f}) m"
    if isinstance(load, PointLoad):
        grams = in_display_unit(load.mass, "kg")
        return f"MASS: {grams} {place}: remove it, or write it to the rig's masses"
    return f"FINGER: the plate is touched {place}: take away what rests there, and measure again"


def _plate_rows(verdict: Verdict) -> list[str]:
    """Lines on how the plate differs from the rig, and on possible explanations."""
    match = verdict.match
    if match is None:
        return []
    if match.error > MAX_FIT_ERROR:
        why = f"{percent(match.error)} unexplained at best"
    else:
        at = best_of(abs(match.z))
        parameter = match.plate.rows[at].name
        why = f"{parameter} would be off by {abs(match.z[at]):.1f} standard deviations"
    rows = [f"PLATE: the rig does not match the plate: {why}"]
    good = [each for each in verdict.explanations if explains(each) and each.share >= _MIN_SHARE]
    changes = [
        (
            each.cause.key,
            in_display_unit(each.expected, each.cause.unit),
            f"{in_display_unit(each.value, each.cause.unit)} would explain it: "
            f"{percent(each.match.error)} unexplained, likelihood {percent(each.share)}",
        )
        for each in good
    ]
    rows += [f"  {row}" for row in value_rows(changes)]
    if good:
        rows.append(f"  correct {good[0].cause.key} in the rig, or the plate; then check again")
    else:
        rows.append(
            "  no single parameter of the rig would explain it: check plate, positions of sensors "
            "and ERAs, and measure for `era calibrate`"
        )
    return rows


def explains(explanation: Explanation) -> bool:
    """Whether the rest of the rig is within its priors with an explanation."""
    return explanation.match.error <= MAX_FIT_ERROR and explanation.match.chance >= FALSE_ALARM


def channel_table(verdict: Verdict) -> list[str]:
    """Table of the channels with a header line."""
    rows = [f"{'ERA':8} {'channel':12} {'drives':8} {'gain':>6} {'phase':>7} {'MAC':>6}  verdict"]
    for channel in verdict.channels:
        gain = "-" if channel.gain is None else f"{channel.gain:.2f}"
        phase = "-" if channel.phase is None else f"{channel.phase:+.0f}°"
        mac = "-" if channel.mac_found is None else f"{channel.mac_found:.3f}"
        rows.append(
            f"{channel.era:8} {channel.channel.amplifier + ':' + str(channel.channel.number):12} "
            f"{channel.drives or '-':8} {gain:>6} {phase:>7} {mac:>6}  "
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
                "mac_of_the_rigs_era": channel.mac_own,
                "mac_of_the_era_found": channel.mac_found,
                "confidence": channel.confidence,
            }
            for channel in verdict.channels
        ],
        "swapped": [list(cycle) for cycle in verdict.swapped],
        "wiring_matches": verdict.wiring_matches,
        "plate": {
            "matches": verdict.plate_matches,
            **_corrections_as_json(verdict),
            "beyond": None if verdict.beyond is None else _beyond_as_json(verdict.beyond),
            "changes": verdict.changes or {},
            "kept_share": verdict.kept_share,
            "promise_margins_db": [*verdict.promise_margins],
            "unexplained": None if match is None else match.error,
            "farthest_standard_deviations": None if match is None else match.worst,
            "parameters": []
            if match is None
            else [
                {
                    "parameter": parameter.name,
                    "unit": parameter.unit,
                    "expected": parameter.of(match.plate.rig),
                    "found": parameter.of(match.rig),
                    "standard_deviations": float(z),
                }
                for parameter, z in zip(match.plate.rows, match.z, strict=True)
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
        "bad_sensors": [{"sensor": each.name, "problem": each.why} for each in verdict.bad_sensors],
        "sensor_count": len(verdict.sensors),
        "drive_frequencies_hz": verdict.frequencies.tolist(),
        "findings": verdict_rows(verdict),
    }


def _beyond_as_json(beyond: BeyondTolerances) -> dict[str, Any]:
    x, y = beyond.taper or (None, None)
    return {
        "kind": beyond.kind,
        "loads": [
            {"x_m": each.x, "y_m": each.y, "mass_kg": getattr(each, "mass", None)}
            for each in beyond.loads
        ],
        "thicker_at_end_of_x": x,
        "thicker_at_end_of_y": y,
        "farthest": beyond.farthest or None,
        "standard_deviations": beyond.deviation or None,
        "unexplained": beyond.error,
    }


def _corrections_as_json(verdict: Verdict) -> dict[str, Any]:
    found: dict[str, Any] = {"grain": None, "resonance_is": {}, "exchanged_sensors": {}}
    found["reversed_axes"] = []
    for each in verdict.corrections:
        match each:
            case TurnedGrain():
                found["grain"] = {
                    "expected": each.as_written,
                    "found": each.along,
                    "unexplained": each.error,
                    "unexplained_as_written": each.error_as_written,
                }
            case MisreadResonance():
                found["resonance_is"] |= each.meant
            case ExchangedSensors():
                found["exchanged_sensors"] |= dict(each.pairs)
            case ReversedAxes():
                found["reversed_axes"] += each.axes
    return found


def _row(channel: ChannelVerdict, state: ChannelState) -> str:
    wiring, remedy = _wiring(channel), _REMEDIES[state]
    match state:
        case "dead":
            return f"DEAD: {wiring} does not move the plate: {remedy}"
        case "other ERA":
            return (
                f"WRONG ERA: {wiring} drives ERA {channel.drives} instead of {channel.era} (MAC "
                f"{channel.mac_found:.3f}, with its own ERA {channel.mac_own:.3f}; "
                f"confidence {channel.confidence:.3f}): {remedy}"
            )
        case "loose":
            return (
                f"LOOSE: {wiring} acts on the plate with a part of its contact only, as an exciter "
                f"whose glue is off: {remedy}"
            )
        case "inverted":
            return f"INVERTED: {wiring} has the opposite sign of the others: {remedy}"
        case "out of phase":
            return f"OUT OF PHASE: {wiring} is off by {channel.phase:+.0f}°: {remedy}"
        case _:
            share = f"{channel.gain:.2f} of the commanded amplitude"
            return f"{state.upper()}: {wiring} plays {share}: {remedy}"


def _common_row(channels: Sequence[ChannelVerdict], state: ChannelState) -> str:
    """Line on nearly all channels being strong or weak, most likely by the sensors."""
    found = {each.era: each.gain for each in channels if state in each.states and each.gain}
    return (
        f"{state.upper()}: the channels of {', '.join(found)} play {min(found.values()):.2f} to "
        f"{max(found.values()):.2f} of the commanded amplitude: check the sensors' sensitivity "
        "first, which makes all of them so together; then the amplifier's volume"
    )


def _wiring(channel: ChannelVerdict) -> str:
    wired = channel.channel
    return f"channel {wired.number} of amplifier {wired.amplifier} (ERA {channel.era} in the rig)"
