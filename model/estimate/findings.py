"""Findings that follow from the verdict of a rig check whose plate and channels are matched.

Reversed entries of a file (positions, grain, resonances) are detected before a fit by
`model.estimate.misread_files`.

To add a kind of fault, add an entry to `FINDING_KINDS` and a function that yields findings from a
verdict, and call it in `with_findings`.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from scipy import linalg
from scipy.special import chdtrc

from model.arrays import FloatArray, Point, best_by, best_of, rms
from model.estimate.hypotheses import Hypothesis
from model.estimate.load_search import Load, match_with_form
from model.estimate.plate_match import FALSE_ALARM, MAX_FIT_ERROR, Match
from model.estimate.verdict import ChannelVerdict, Finding, Verdict
from model.quantities import counted, in_display_unit, percent
from model.structure.attachments import PointLoad
from model.structure.fingertips import FingertipLoad

MAX_FORM_ERROR = 0.05
"""Largest unexplained share of the responses of a plate that form errors explain."""

_ORDER = ("file", "channel", "sensor", "plate", "load", "form")  # of the findings of a verdict
_NEARLY_ALL = 0.75  # of the channels
_MIN_SHARE = 0.05  # likelihood of a reported hypothesis
_DETACHED = 0.1  # of the stiffness of an ERA
_HEAVY = 0.02  # of the plate's mass, all masses together: twice the tolerance of foreign mass
_MIN_VARIANCE = 1e-6  # of a slope
_THICKNESS = "thickness"
_FORM = {
    "place": "places of ERAs",
    "mode_shifts": "natural frequencies",
    "sensor_scale": "scales of sensors",
    "sensor_place": "places of sensors",
    "foreign_mass": "distribution of mass",
    "side": "length and width",
    "poisson": "Poisson's ratio",
}
"""Names of form errors by kind of parameter."""


def with_findings(verdict: Verdict) -> Verdict:
    """Return the verdict with the findings that follow from it added."""
    findings = [
        *_swapped_channels(verdict),
        *_channel_faults(verdict),
        *_plate_differences(verdict),
        *_detached_eras(verdict),
        *verdict.findings,
    ]
    findings.sort(key=lambda finding: _ORDER.index(finding.about))
    return replace(verdict, findings=tuple(findings))


def cycles(channels: Sequence[ChannelVerdict]) -> list[list[ChannelVerdict]]:
    """Return cycles of channels that drive each other's ERAs, each from its first channel."""
    by_era = {channel.era: channel for channel in channels}
    complete: list[list[ChannelVerdict]] = []
    for first in channels:
        cycle = [first]
        driven = first.drives
        while driven is not None and by_era[driven] not in cycle:
            cycle.append(by_era[driven])
            driven = cycle[-1].drives
        is_repeated = any(first in earlier for earlier in complete)
        if driven == first.era and len(cycle) > 1 and not is_repeated:
            complete.append(cycle)
    return complete


def _swapped_channels(verdict: Verdict) -> Iterator[Finding]:
    """Yield cycles of channels that drive each other's ERAs."""
    for cycle in cycles(verdict.channels):
        eras = [channel.era for channel in cycle]
        details = {
            "channel_1": cycle[0].wiring,
            "channel_2": cycle[1].wiring,
            "era_1": eras[0],
            "era_2": eras[1],
        }
        yield Finding(
            kind="swapped" if len(cycle) == 2 else "cycle",
            of=", ".join(eras),
            confidence=min(channel.confidence for channel in cycle),
            details=details,
        )


def _channel_faults(verdict: Verdict) -> Iterator[Finding]:
    """Yield problems of channels, common ones first, without swapped channels."""
    common = {"well", "not driven"}
    for finding, state in _common_faults(verdict.channels):
        yield finding
        common.add(state)
    swapped = []
    for cycle in cycles(verdict.channels):
        swapped += cycle
    for channel in verdict.channels:
        details = {**vars(channel), "wiring": channel.wiring}
        for state in channel.states:
            is_swapped = state == "other ERA" and channel in swapped
            if state not in common and not is_swapped:
                yield Finding(
                    kind=state,
                    of=channel.era,
                    value=channel.gain or 0.0,
                    confidence=channel.confidence,
                    details=details,
                )


def _common_faults(channels: Sequence[ChannelVerdict]) -> Iterator[tuple[Finding, str]]:
    """Yield problems that nearly all driven channels have, with their states."""
    driven = [channel for channel in channels if channel.drives is not None]
    for state in ("strong", "weak"):
        gains = {}
        for channel in driven:
            if state in channel.states and channel.gain:
                gains[channel.era] = channel.gain
        if len(gains) > 1 and len(gains) >= _NEARLY_ALL * len(driven):
            details = {"state": state.upper(), "least": min(gains.values())}
            highest = max(gains.values())
            yield Finding("all strong or weak", ", ".join(gains), highest, details=details), state
            break
    inverted = [channel for channel in driven if "inverted" in channel.states]
    if len(inverted) > 1 and len(inverted) == len(driven):
        yield Finding("all inverted", "all"), "inverted"


def _plate_differences(verdict: Verdict) -> Iterator[Finding]:
    """Yield differences of the plate from the rig, and the hypotheses that would explain them.

    A loose exciter is named instead. Without differences, outliers are counted.
    """
    match = verdict.match
    if match is None:
        return
    is_loose = any("loose" in channel.states for channel in verdict.channels)
    if verdict.plate_matches or is_loose:
        yield from _outliers(match, verdict.sensors)
        return
    reason = f"{percent(match.error)} unexplained at best"
    if match.error <= MAX_FIT_ERROR:
        farthest = best_of(abs(match.z))
        name = match.plate.parameters[farthest].name
        reason = f"{name} would be off by {abs(match.z[farthest]):.1f} standard deviations"
    good = []
    for hypothesis in verdict.hypotheses:
        if hypothesis.explains and hypothesis.share >= _MIN_SHARE:
            good.append(hypothesis)
    details = {"why": reason, "hypotheses": "\n".join(_hypothesis_rows(good))}
    key = good[0].key if good else ""
    yield Finding("plate", key, match.worst, details=details)


def _outliers(match: Match, sensors: Sequence[str]) -> Iterator[Finding]:
    """Yield the number of outliers, if there are any."""
    by_sensor = match.outliers.sum(axis=(0, 2))
    count = int(by_sensor.sum())
    if count:
        worst = best_of(by_sensor)
        details = {"count": counted(count, "value")}
        yield Finding("outliers", sensors[worst], int(by_sensor[worst]), details=details)


def _hypothesis_rows(hypotheses: Sequence[Hypothesis]) -> list[str]:
    """Return lines of hypotheses that explain a plate, most likely first, and the remedy."""
    if not hypotheses:
        return [
            "  no single parameter of the rig would explain it: check plate, positions of sensors "
            "and ERAs, and measure for `era calibrate`"
        ]
    width = max(len(hypothesis.key) for hypothesis in hypotheses)
    rows = []
    for hypothesis in hypotheses:
        expected = in_display_unit(hypothesis.expected, hypothesis.unit)
        value = in_display_unit(hypothesis.value, hypothesis.unit)
        rows.append(
            f"  {hypothesis.key:{width}}  {expected} -> {value} would explain it: "
            f"{percent(hypothesis.match.error)} unexplained, likelihood {percent(hypothesis.share)}"
        )
    rows.append(f"  correct {hypotheses[0].key} in the rig, or the plate; then check again")
    return rows


def _detached_eras(verdict: Verdict) -> Iterator[Finding]:
    """Yield an ERA that hardly holds the plate, if this is the likeliest hypothesis."""
    for hypothesis in verdict.hypotheses[:1]:
        is_soft = hypothesis.value < _DETACHED * hypothesis.expected
        if hypothesis.era and hypothesis.explains and is_soft:
            yield Finding("detached", hypothesis.era, hypothesis.value / hypothesis.expected)


def match_beyond(match: Match) -> tuple[Match, list[Finding]]:
    """Match a plate again with form errors and loads, and find those beyond tolerances."""
    best, loads = match_with_form(match)
    mass = sum(load.mass for load in loads if isinstance(load, PointLoad))
    if mass < _HEAVY * match.plate.rig.plate.mass:
        # A mass within tolerance is not a fault, and neither are form errors that could replace it.
        loads = [load for load in loads if isinstance(load, FingertipLoad)]
    if loads:
        return best, [_load_finding(load, best.error) for load in loads]
    finding = _form_finding(best)
    return best, [finding] if finding else []


def _load_finding(load: Load, error: float) -> Finding:
    """Return the finding of a load; error: unexplained share of the responses."""
    details: dict[str, Any] = {"x_m": load.x, "y_m": load.y}
    if isinstance(load, PointLoad):
        json = {"loads": [{**details, "mass_kg": load.mass}], "unexplained": error}
        details["grams"] = in_display_unit(load.mass, "kg")
        return Finding("mass", "plate", load.mass, details=details, json=json)
    json = {"loads": [{**details, "mass_kg": None}], "unexplained": error}
    return Finding("finger", "plate", details=details, json=json)


class _FormTest(NamedTuple):
    """Test of a kind of form errors against their tolerance."""

    name: str
    size: float
    """RMS of the errors in standard deviations."""
    chance: float
    """Share of correct plates with errors at least as large, or an upper bound of it."""


def _form_finding(match: Match) -> Finding | None:
    """Return the form error that is least likely on correct plates, or the unexplained response,
    None if both are within tolerances."""
    slope, taper = _along_plate(match)
    tests = []
    for kind, name in _FORM.items():
        z = match.fit.x[match.fit.space.of(kind)]
        tests.append(_FormTest(name, rms(z), len(_FORM) * float(chdtrc(len(z), z @ z))))
    tests.append(_FormTest(_THICKNESS, rms(slope), float(chdtrc(len(slope), slope @ slope))))
    farthest = best_by(tests, lambda test: -test.chance)
    if farthest.chance < FALSE_ALARM:
        return _form_error_finding(farthest, taper, match.error)
    if match.error <= MAX_FORM_ERROR:
        return None
    details = {"difference": f"{percent(match.error)} of the response is unexplained"}
    json = {"unexplained": match.error}
    return Finding("unnamed", "response", match.error, details=details, json=json)


def _form_error_finding(test: _FormTest, taper: Point, error: float) -> Finding:
    """Return the finding of a form error beyond its tolerance.

    taper: relative, at the ends of x and of y; error: unexplained share of the responses.
    """
    _, size, chance = test
    json = {"unexplained": error, "farthest": test.name, "standard_deviations": size}
    if test.name == _THICKNESS:
        x, y = taper
        details = {"along_x": f"{100 * x:+.1f} %", "along_y": f"{100 * y:+.1f} %"}
        json |= {"thicker_at_end_of_x": x, "thicker_at_end_of_y": y}
        return Finding("thickness", "ends", size, chance=chance, details=details, json=json)
    difference = f"{test.name} are off by {size:.1f} standard deviations of their tolerance"
    details = {"difference": difference}
    return Finding("unnamed", test.name, size, chance=chance, details=details, json=json)


def _along_plate(match: Match) -> tuple[FloatArray, Point]:
    """Return the slope of sensor scales along both sides (2,), and the taper that explains it.

    A plate moves more at a thinner end. The slope is relative to its standard error, the taper is
    relative at the ends of x and of y. The fit's prior reduces scales, so the scales of good plates
    vary by less than their tolerance.
    """
    space = match.fit.space
    part = space.groups["sensor_scale"]
    points = match.fit.measurement.points
    along = 2 * points / match.plate.sides - 1
    basis = np.linalg.qr(np.column_stack([np.ones(len(points)), along]))[0][:, 1:]
    # Covariance of fitted scales on plates within tolerances, then of their slopes.
    scale_covariance = np.eye(len(points)) - match.linearized().stated_covariance[part, part]
    covariance = basis.T @ scale_covariance @ basis + _MIN_VARIANCE * np.eye(2)
    slope = basis.T @ match.fit.x[part]
    thinner = basis @ linalg.solve(covariance, slope) * space.std[part]
    taper = -np.linalg.lstsq(along - along.mean(axis=0), thinner)[0]
    root = linalg.cholesky(covariance, lower=True)
    return linalg.solve(root, slope), (float(taper[0]), float(taper[1]))
