"""Findings of a rig check: their kinds and texts, and the functions that detect them.

A kind is an entry of `FINDING_KINDS`, which is also the source of a table in
`docs/how-to/measure-your-plate.md`. Reversed entries of a file (positions, grain, resonances) are
detected before a fit by `model.estimate.misread_files`. All other findings follow from a `Verdict`
whose plate and channels are matched.

To add a kind of fault, add an entry to `FINDING_KINDS` and a function that yields findings from a
verdict, and call it in `with_findings`.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
from scipy import linalg
from scipy.special import chdtrc

from model.arrays import FloatArray, Point, best_by, best_of, rms
from model.estimate.hypotheses import Hypothesis
from model.estimate.load_search import Load, match_with_form
from model.estimate.plate_match import FALSE_ALARM, MAX_FIT_ERROR, Match
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


@dataclass(frozen=True)
class FindingKind:
    """A kind of finding."""

    text: str
    """Printed line with placeholders for fields and details of a finding: problem and remedy."""
    criterion: str
    """Criterion of the finding, as printed on the page."""
    about: str = "channel"
    """Subject: `file` (the rig file describes it the wrong way round), `channel`, `sensor` (left
    out), `plate`, `load` (object on the plate) or `form` (difference that no rig key describes)."""
    is_fault: bool = True
    """Whether it fails the check."""


FINDING_KINDS = {
    "mirrored": FindingKind(
        "PLACES: sensor positions must be measured from the same corner as ERA positions, "
        "got positions mirrored in {of}: {coarse}; correct all sensor positions{or_plugs}",
        "in a coarse fit, mirrored sensor positions reduce the unexplained share to less than 0.6 "
        "of its value; the check continues with the mirrored positions",
        "file",
    ),
    "reversed": FindingKind(
        "PLACES: frequencies must be in the order of their responses, got reversed order: {coarse}",
        "as for `mirrored`, with the frequencies in reverse order",
        "file",
    ),
    "exchanged": FindingKind(
        "PLACES: sensors must be at their stated positions, got exchanged positions: "
        "{of}; correct the positions or names",
        "responses fit the position of another sensor (coherence above 0.9; below 0.8 at their "
        "own position); the check continues with the positions corrected",
        "file",
    ),
    "grain": FindingKind(
        "GRAIN: plate.grain must be {along}, got {as_written}: a coarse fit leaves {percent} of "
        "the responses unexplained with the grain along the {along}, {percent_as_written} with "
        "the grain along the {as_written}; look at the veneer of its faces, and correct the rig",
        "in a coarse fit, the grain along the other side reduces the unexplained share to less "
        "than 0.6 of its value; the check continues with that grain",
        "file",
    ),
    "resonance": FindingKind(
        "RESONANCE: resonance_is of {of} must be {which}, got {as_written}: if {which}, "
        "a glued magnet resonates at {value:.0f} Hz and gains vary by a factor of "
        "{factor:.2g} over frequency; if {as_written}, by {factor_as_written:.2g}; correct the rig",
        "gains of exciters vary too much over frequency (standard deviation of their logarithm "
        "above 0.8), but less than half as much with the other `resonance_is`; the check "
        "continues with the other",
        "file",
    ),
    "swapped": FindingKind(
        "SWAPPED: {channel_1} drives ERA {era_2}, and {channel_2} drives ERA {era_1} (confidence "
        "{confidence:.3f}): exchange the two plugs, or the channels in the rig",
        "two channels drive each other's ERA (criterion: `other ERA`)",
    ),
    "cycle": FindingKind(
        "SWAPPED in a cycle: the channels of {of} each drive the next one's ERA (confidence "
        "{confidence:.3f}): correct the plugs",
        "three or more channels drive each other's ERAs in a cycle",
    ),
    "all strong or weak": FindingKind(
        "{state}: the channels of {of} play {least:.2f} to {value:.2f} of the "
        "commanded amplitude: check the sensors' sensitivity first, which affects all channels "
        "alike; then the amplifier's volume",
        "three quarters of the channels are strong, or three quarters are weak",
    ),
    "all inverted": FindingKind(
        "INVERTED: all channels have the opposite sign of the sensors: turn "
        "the sensors over, swap the two wires of every ERA, or check the sign convention of phases",
        "all channels are inverted",
    ),
    "dead": FindingKind(
        "DEAD: {wiring} does not move the plate: check its supply, its cable and the "
        "amplifier's channel",
        "the response is below 3 % of the prediction, or faint and unlike the prediction for any "
        "ERA",
    ),
    "loose": FindingKind(
        "LOOSE: {wiring} acts on the plate with only part of its contact, such as an exciter "
        "whose glue has come off: press it on or glue it again, and measure again",
        "the plate does not match, and the parameter farthest off is the stiffness or weight of "
        "an exciter, below 0.7 of its value; or a channel's gain rises with frequency relative to "
        "the other channels",
    ),
    "weak": FindingKind(
        "WEAK: {wiring} plays {value:.2f} of the commanded amplitude: check its voltage, "
        "volume and mounting, or measure its gain with `era calibrate`",
        "the gain is below 0.8 of the rig's; in a rig with large `uncertainty`, 3.5 standard "
        "deviations of `gain` (for exciters also `stiffness`) below the rig's",
    ),
    "strong": FindingKind(
        "STRONG: {wiring} plays {value:.2f} of the commanded amplitude: lower its voltage or "
        "volume, or correct its stroke or gains in the rig",
        "as for `weak`, but above 1.25 of the rig's",
    ),
    "other ERA": FindingKind(
        "WRONG ERA: {wiring} drives ERA {drives} instead of {of} (MAC {mac_found:.3f}, with its "
        "own ERA {mac_own:.3f}; confidence {confidence:.3f}): correct the plug, or the rig's "
        "channels",
        "the response shape over the sensors fits another ERA (MAC over the frequencies; "
        "confidence from a t-test), and this explains the whole plate better",
    ),
    "inverted": FindingKind(
        "INVERTED: {wiring} has the opposite sign of the others: swap its two wires",
        "the phase relative to the drive is off by 90° or more",
    ),
    "out of phase": FindingKind(
        "OUT OF PHASE: {wiring} is off by {phase:+.0f}°: measure its gains with `era calibrate`",
        "the phase is off by more than 45°",
    ),
    "silent": FindingKind(
        "SENSOR {of} has no signal: left out",
        "no signal from any channel; the sensor is left out",
        "sensor",
        is_fault=False,
    ),
    "mute": FindingKind(
        "SENSOR {of} reads {value:.2f} times the value implied by the other sensors: check its "
        "position and its cable: left out",
        "at most a tenth of the value implied by the other sensors; left out",
        "sensor",
        is_fault=False,
    ),
    "upside down": FindingKind(
        "SENSOR {of} is upside down (reads {value:.2f} times the value implied by the other "
        "sensors): turn it over: left out",
        "opposite sign, and at least half of the value implied by the other sensors; left out",
        "sensor",
        is_fault=False,
    ),
    "off scale": FindingKind(
        "SENSOR {of} reads {value:.2f} times the value implied by the other sensors: left out",
        "less than 0.7 or more than 1.4 times the value implied by the other sensors; left out",
        "sensor",
        is_fault=False,
    ),
    "plate": FindingKind(
        "PLATE: the rig does not match the plate: {why}\n{hypotheses}",
        "no plate within the rig's tolerances explains the measurement",
        "plate",
    ),
    "detached": FindingKind(
        "DETACHED: ERA {of} holds the plate with {value:.2f} of its stiffness: tighten its bolt, "
        "or look for a spring that came off",
        "the plate is best explained by an ERA with less than a tenth of its stiffness",
        "plate",
    ),
    "outliers": FindingKind(
        "OUTLIERS: {count} left out, including {value} at sensor {of}: check for loose "
        "contacts if they are many",
        "values that a calibration would leave out, up to 5 % of all",
        "plate",
        is_fault=False,
    ),
    "mass": FindingKind(
        "MASS: {grams} at ({x_m:.2f}, {y_m:.2f}) m: remove it, or write it to the rig's masses",
        "one or two additional masses, together at least 2 % of the plate's mass",
        "load",
    ),
    "finger": FindingKind(
        "FINGER: the plate is touched at ({x_m:.2f}, {y_m:.2f}) m: remove the object "
        "there, and measure again",
        "a soft, damped load, such as a fingertip",
        "load",
    ),
    "thickness": FindingKind(
        "THICKNESS: according to its sensors, the plate is {along_x} thicker at the end of x and "
        "{along_y} at the end of y than in its middle: check it, or the sensors' scales",
        "the plate is thicker at one end, or the sensors' scales rise toward it",
        "form",
    ),
    "unnamed": FindingKind(
        "UNNAMED: values match the rig, but something else differs: {difference}; "
        "check the plate's thickness, parts bonded to it and the sensors' scales, and measure for "
        "`era calibrate`",
        "form errors (which no rig key describes) are larger than on 99 % of plates, for example "
        "due to a bonded frame; or more than 5 % is unexplained",
        "form",
    ),
    "promise": FindingKind(
        "PROMISE: half of the answers of the rig's table miss their promised contrast "
        "by {value:.1f} dB or more",
        "half of the answers of the rig's table miss their promise by 1 dB or more",
        "plate",
    ),
}
"""All kinds of findings by name."""


@dataclass(frozen=True)
class Finding:
    """A fault or remark that a check reports."""

    kind: str
    """Key of `FINDING_KINDS`."""
    of: str
    """Name of the part it concerns."""
    value: float = 0.0
    """Size, as printed in its text."""
    confidence: float = 1.0
    """Confidence 0..1 in it."""
    chance: float = 1.0
    """Share of plates as written that look as far off or further."""
    details: Mapping[str, Any] = field(default_factory=dict)
    """Additional values for the text."""
    json: Mapping[str, Any] = field(default_factory=dict)
    """Additional JSON keys of the plate: for a `file` its key, for a load or form its
    properties."""

    @property
    def about(self) -> str:
        """Subject; see `FindingKind.about`."""
        return FINDING_KINDS[self.kind].about

    @property
    def rows(self) -> list[str]:
        """Return printed lines: problem and remedy."""
        values = {"of": self.of, "value": self.value, "confidence": self.confidence}
        return FINDING_KINDS[self.kind].text.format(**{**self.details, **values}).splitlines()

    @property
    def rule(self) -> str:
        """Return the first printed line without its heading."""
        return self.rows[0].partition(": ")[2]

    @property
    def is_fault(self) -> bool:
        """Whether it fails the check."""
        return FINDING_KINDS[self.kind].is_fault


@dataclass(frozen=True)
class ChannelVerdict:
    """Verdict on a channel: the ERA it is wired to in the rig, the ERA it drives, and its
    states."""

    era: str
    """ERA to which the rig wires it."""
    amplifier: str
    """Name of its amplifier."""
    channel: int
    """Its number there."""
    states: tuple[str, ...]
    """Problems, as kinds of findings; only "well" without problems, or "not driven"."""
    drives: str | None = None
    """ERA that it drives, None for a dead or undriven channel."""
    gain: float | None = None
    """Gain relative to the command and the rig's gains."""
    phase: float | None = None
    """Phase error [degrees], None if unknown."""
    mac_own: float | None = None
    """Median MAC with the rig's ERA."""
    mac_found: float | None = None
    """Median MAC with the ERA that it drives."""
    confidence: float = 0.0
    """Confidence 0..1 in `drives` and `states`."""

    @property
    def wiring(self) -> str:
        """The channel in words."""
        return f"channel {self.channel} of amplifier {self.amplifier} (ERA {self.era} in the rig)"


@dataclass(frozen=True, eq=False)
class Verdict:
    """Result of a rig check."""

    channels: tuple[ChannelVerdict, ...]
    sensors: tuple[str, ...]
    """Names of the sensors that were used."""
    frequencies: FloatArray
    """Tones that were used (f,) [Hz]."""
    findings: tuple[Finding, ...] = ()
    """Findings, in the order in which to check them."""
    plate_matches: bool = True
    """Whether the rig's plate within its priors explains the measurement."""
    match: Match | None = None
    """That plate."""
    hypotheses: tuple[Hypothesis, ...] = ()
    """Other plates that explain it if the rig's does not, most likely first."""
    changes: Mapping[str, float] | None = None
    """Relative differences from the rig as `plate_changes`, None without a plate that fits."""
    promise_margins: tuple[float, ...] = ()
    """Margins [dB] of the plate's contrasts over the promises of the rig's table; empty if not
    compared."""

    def of_kinds(self, *kinds: str) -> list[Finding]:
        """Return the findings of some kinds."""
        return [finding for finding in self.findings if finding.kind in kinds]

    def about(self, *subjects: str) -> list[Finding]:
        """Return the findings about some subjects; see `FindingKind.about`."""
        return [finding for finding in self.findings if finding.about in subjects]

    @property
    def wiring_matches(self) -> bool:
        """Whether every driven channel drives its own ERA."""
        return all(set(channel.states) <= {"well", "not driven"} for channel in self.channels)

    @property
    def is_well(self) -> bool:
        """Whether no fault was found."""
        return not any(finding.is_fault for finding in self.findings)

    @property
    def kept_share(self) -> float | None:
        """Fraction of the table's promises that the plate keeps, None if not compared."""
        if not self.promise_margins:
            return None
        return float(np.mean(np.array(self.promise_margins) >= 0))


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
