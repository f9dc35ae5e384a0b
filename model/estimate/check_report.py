"""Report of a rig check: lines for people, and JSON."""

from typing import Any

from model.estimate.findings import cycles
from model.estimate.hypotheses import Hypothesis
from model.estimate.plate_match import Match
from model.estimate.verdict import ChannelVerdict, Finding, Verdict
from model.quantities import percent
from model.study.verification import MIN_KEPT_SHARE

_MIN_CHANGE = 0.03  # relative, of a reported value

_CHANGE_NAMES = {
    "loss_factor": "loss factor",
    "stiffness": "ERA stiffness",
    "damping": "ERA damping",
}


def verdict_rows(verdict: Verdict) -> list[str]:
    """Return lines of findings with their remedies, or a line that all is well."""
    rows = []
    for finding in verdict.findings:
        rows += finding.rows
    if verdict.is_well and not verdict.about("sensor"):
        if difference_rows(verdict):
            rows.append("WIRING WELL: every driven channel drives its own ERA")
        else:
            rows.append("ALL WELL: plate and channels match the rig")
    return rows


def difference_rows(verdict: Verdict) -> list[str]:
    """Return a line on a plate that keeps too few of the rig's promises; empty if it keeps
    enough."""
    kept_share = verdict.kept_share
    if verdict.changes is None or kept_share is None or kept_share >= MIN_KEPT_SHARE:
        return []
    changes = []
    for kind, change in verdict.changes.items():
        if abs(change) >= _MIN_CHANGE:
            changes.append(f"{_CHANGE_NAMES.get(kind, kind)} {100 * change:+.0f} %")
    difference = ", ".join(changes) or "single ERAs or bolts"
    if verdict.about("form"):
        difference = "in a way that no parameter describes"
    elif verdict.plate_matches:
        difference = f"within tolerances, but off its nominal values: {difference}"
    return [
        f"PLATE DIFFERS: {difference}; the plate keeps {percent(kept_share)} of the promises of "
        "the rig's table: calibrate it with `era calibrate`"
    ]


def channel_table(verdict: Verdict) -> list[str]:
    """Return a table of the channels with a header line."""
    rows = [f"{'ERA':8} {'channel':12} {'drives':8} {'gain':>6} {'phase':>7} {'MAC':>6}  verdict"]
    for channel in verdict.channels:
        gain, phase, mac = "-", "-", "-"
        if channel.gain is not None:
            gain = f"{channel.gain:.2f}"
        if channel.phase is not None:
            phase = f"{channel.phase:+.0f}°"
        if channel.mac_found is not None:
            mac = f"{channel.mac_found:.3f}"
        output = f"{channel.amplifier}:{channel.channel}"
        rows.append(
            f"{channel.era:8} {output:12} {channel.drives or '-':8} {gain:>6} {phase:>7} {mac:>6}  "
            f"{', '.join(channel.states)}"
        )
    return rows


def as_json(verdict: Verdict) -> dict[str, Any]:
    """Return the verdict as JSON; units are in the keys."""
    swapped = [[channel.era for channel in cycle] for cycle in cycles(verdict.channels)]
    return {
        "all_well": verdict.is_well,
        "channels": list(map(_channel_json, verdict.channels)),
        "swapped": swapped,
        "wiring_matches": verdict.wiring_matches,
        "plate": _plate_json(verdict),
        "bad_sensors": list(map(_sensor_json, verdict.about("sensor"))),
        "sensor_count": len(verdict.sensors),
        "drive_frequencies_hz": verdict.frequencies.tolist(),
        "findings": verdict_rows(verdict),
    }


def _channel_json(channel: ChannelVerdict) -> dict[str, Any]:
    return {
        "era": channel.era,
        "amplifier": channel.amplifier,
        "channel": channel.channel,
        "states": list(channel.states),
        "drives": channel.drives,
        "gain": channel.gain,
        "phase_deg": channel.phase,
        "mac_of_the_rigs_era": channel.mac_own,
        "mac_of_the_era_found": channel.mac_found,
        "confidence": channel.confidence,
    }


def _sensor_json(finding: Finding) -> dict[str, str]:
    problem = finding.rows[0].removeprefix(f"SENSOR {finding.of} ").removesuffix(": left out")
    return {"sensor": finding.of, "problem": problem}


def _plate_json(verdict: Verdict) -> dict[str, Any]:
    corrections: dict[str, Any] = {
        "grain": None,
        "resonance_is": {},
        "exchanged_sensors": {},
        "reversed_axes": [],
    }
    for finding in verdict.about("file"):
        corrections |= finding.json
    match = verdict.match
    return {
        "matches": verdict.plate_matches,
        **corrections,
        "beyond": _beyond_json(verdict.about("load", "form")),
        "changes": verdict.changes or {},
        "kept_share": verdict.kept_share,
        "promise_margins_db": [*verdict.promise_margins],
        "unexplained": match and match.error,
        "farthest_standard_deviations": match and match.worst,
        "parameters": _parameters_json(match),
        "explanations": list(map(_hypothesis_json, verdict.hypotheses)),
    }


def _beyond_json(findings: list[Finding]) -> dict[str, Any] | None:
    """Return loads and differences that no parameter describes, None without any."""
    if not findings:
        return None
    loads = []
    for finding in findings:
        loads += finding.json.get("loads", [])
    return {
        "kind": findings[0].kind,
        "thicker_at_end_of_x": None,
        "thicker_at_end_of_y": None,
        "farthest": None,
        "standard_deviations": None,
        **findings[0].json,
        "loads": loads,
    }


def _parameters_json(match: Match | None) -> list[dict[str, Any]]:
    if match is None:
        return []
    rows = []
    for parameter, z in zip(match.plate.parameters, match.z.tolist(), strict=True):
        rows.append(
            {
                "parameter": parameter.name,
                "unit": parameter.unit,
                "expected": parameter.of(match.plate.rig),
                "found": parameter.of(match.rig),
                "standard_deviations": z,
            }
        )
    return rows


def _hypothesis_json(hypothesis: Hypothesis) -> dict[str, Any]:
    return {
        "key": hypothesis.key,
        "unit": hypothesis.unit,
        "expected": hypothesis.expected,
        "found": hypothesis.value,
        "explains": hypothesis.explains,
        "likelihood": hypothesis.share,
        "unexplained": hypothesis.match.error,
    }
