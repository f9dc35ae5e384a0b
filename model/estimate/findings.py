"""Findings of a rig check: their kinds and texts, and the functions that detect them.

A kind is an entry of `FINDING_KINDS`, which is also the source of a table in
`docs/how-to/measure-your-plate.md`, and a function in this module. Reversed entries of a file
(positions, grain, resonances) describe another plate, which no fit of values can replace. They
are detected from response shapes and corrected first: on boards as bought, a fit with the right
entry leaves a quarter of the response unexplained, with the reversed one half to nine tenths. All
other findings follow from a `Verdict` whose plate and channels are matched.

To add a kind of fault, add an entry to `FINDING_KINDS` and a function that yields findings from a
verdict, and call it in `with_findings`.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, TypeAlias

import numpy as np
from scipy import linalg
from scipy.optimize import linear_sum_assignment
from scipy.special import chdtrc

from model.arrays import ComplexArray, FloatArray, best_by, best_of, rms
from model.estimate.fit import SensedPlate, gains_of, plate_of, row_rms
from model.estimate.identify import solved_for
from model.estimate.measurement import Measurement
from model.estimate.plate_match import (
    FALSE_ALARM,
    MAX_FIT_ERROR,
    Hypothesis,
    Load,
    Match,
    ShapeMatch,
    linearised,
    match_shapes,
    match_with_form,
)
from model.quantities import counted, in_display_unit, percent
from model.rig.rig import Rig
from model.rig.rig_summary import exciters_of, sections_of
from model.rig.rig_writing import change_rig
from model.structure.attachments import FingertipLoad, PointLoad

MAX_FORM_ERROR = 0.05
"""Largest unexplained share of the responses of a plate that form errors explain."""

_OWN_PLACE, _OTHER_PLACE = 0.8, 0.9  # coherence of an exchanged sensor, at most and at least
_MAX_COARSE_ERROR = 0.45  # of a coarse fit of the right board that has a fault
_CLEARLY_LESS = 0.6  # of the error as written
_OTHER_MEANING = {"free": "mounted", "mounted": "free"}
_MAX_VARIATION = 0.8  # standard deviation of logarithms of gains; no drive has more
_CLEARLY_STEADIER = 0.5  # of the variation as written

_ORDER = ("file", "channel", "sensor", "plate", "load", "form")  # in which to look at findings
_NEARLY_ALL = 0.75  # of the channels
_MIN_SHARE = 0.05  # likelihood of a reported hypothesis
_HEAVY = 0.02  # of the plate's mass, all masses together: twice the tolerance of foreign mass
_MIN_SHOWN = 1e-6  # of a variance
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
        "SWAPPED: {one} drives ERA {second}, and {other} drives ERA {first} (confidence "
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
        "UNNAMED: values match the rig, but something else differs: {said}; "
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
    """Something that a check found."""

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
        own = {"of": self.of, "value": self.value, "confidence": self.confidence}
        return FINDING_KINDS[self.kind].text.format(**{**self.details, **own}).splitlines()

    @property
    def is_fault(self) -> bool:
        """Whether it fails the check."""
        return FINDING_KINDS[self.kind].is_fault


Correction: TypeAlias = tuple[Finding, Rig, Measurement]
"""Finding about a wrong rig file, with the corrected rig and measurement."""


def reversed_axes(
    plate: SensedPlate, shapes: ShapeMatch, observation: Measurement, *, may_be_plugs: bool
) -> Correction | None:
    """Find the axes along which a measurement is noted the wrong way round.

    Channels drive the ERAs of the rig. shapes: match of the observation with the rig's plate;
    may_be_plugs: whether exchanged channels may explain the observation as well.
    """
    rig, as_written = plate.rig, shapes.error()
    if not as_written > _MAX_COARSE_ERROR:
        return None
    tried = []
    for axes in (("x",), ("y",), ("x", "y"), ("frequency",)):
        size = np.array([rig.plate.length, rig.plate.width])
        points = np.abs(size * [axis in axes for axis in "xy"] - observation.points)
        values = observation.values[:: -1 if axes == ("frequency",) else 1]
        right = replace(observation.moved(points), values=values)
        tried.append((match_shapes(plate_of(rig, right), values).error(), axes, right))
    error, axes, right = best_by(tried, lambda each: -each[0])
    are_plugs = shapes.error(shapes.nearest) * _CLEARLY_LESS < error
    too_large = error >= min(_MAX_COARSE_ERROR, _CLEARLY_LESS * as_written)
    if too_large or (are_plugs and not may_be_plugs):
        return None
    kind, names = "reversed" if axes == ("frequency",) else "mirrored", " and ".join(axes)
    details = {
        "coarse": f"with {names} from the other end a coarse fit leaves {percent(error)} of the "
        f"responses unexplained, as written {percent(as_written)}",
        "or_plugs": ", or plug the channels as the rig has them" if are_plugs else "",
    }
    return Finding(kind, names, details=details, json={"reversed_axes": [*axes]}), rig, right


def exchanged_sensors(match: Match, observation: Measurement) -> Correction | None:
    """Find sensors whose values match the plate at another sensor's position."""
    values, model = match.values, match.responses[..., match.drives]
    known, size = np.isfinite(values), row_rms(values)
    measured = np.where(known, values, 0) / size
    predicted = np.nan_to_num(gains_of(model, values))[:, None] * model / size
    inner = np.abs(np.einsum("fsn,fpn->sp", measured, predicted.conj()))
    own = (np.abs(measured) ** 2).sum(axis=(0, 2))
    other = np.einsum("fsn,fpn->sp", known.astype(float), np.abs(predicted) ** 2)
    coherence = inner / np.sqrt(np.maximum(own[:, None] * other, 1e-300))
    at_own, names, points = np.diag(coherence), observation.names, observation.points.copy()
    pairs = {}
    for sensor, place in zip(*linear_sum_assignment(-(coherence**2)), strict=True):
        # Both must be wrong: else two sensors are at one place, which is no exchange.
        is_off = max(at_own[sensor], at_own[place]) < _OWN_PLACE
        if is_off and coherence[sensor, place] > _OTHER_PLACE:
            pairs[names[sensor]] = names[place]
            points[sensor] = observation.points[place]
    if not pairs:
        return None
    said = ", ".join(f"{name} at that of {place}" for name, place in pairs.items())
    found = Finding("exchanged", said, json={"exchanged_sensors": pairs})
    return found, match.plate.rig, observation.moved(points)


def other_meaning(
    plate: SensedPlate, shapes: ShapeMatch, observation: Measurement
) -> Correction | None:
    """Find a value that the rig of a plate has the wrong way round, the grain first.

    shapes: match of the observation with that plate. None if neither is clearly wrong.
    """
    return turned_grain(plate, shapes, observation) or misread_resonance(plate, shapes, observation)


def turned_grain(
    plate: SensedPlate, shapes: ShapeMatch, observation: Measurement
) -> Correction | None:
    """Find the board with the grain along the other side, if that clearly explains more."""
    rig = plate.rig
    if rig.plate.material.orthotropy is None:
        return None
    turned = replace(rig, plate=replace(rig.plate, material=rig.plate.material.turned()))
    turned = replace(turned, mesh=solved_for(turned, rig.limits.frequency_max).mesh)
    tried = match_shapes(plate_of(turned, observation), observation.values)
    error, as_written = (each.error(each.nearest) for each in (tried, shapes))
    if error > min(_MAX_COARSE_ERROR, _CLEARLY_LESS * as_written):
        return None
    along = "length" if rig.grain == "width" else "width"
    found = {
        "expected": rig.grain,
        "found": along,
        "unexplained": error,
        "unexplained_as_written": as_written,
    }
    details = {
        "along": along,
        "as_written": rig.grain,
        "percent": percent(error),
        "percent_as_written": percent(as_written),
    }
    finding = Finding("grain", "plate.grain", details=details, json={"grain": found})
    return finding, turned, observation


def misread_resonance(
    plate: SensedPlate, shapes: ShapeMatch, observation: Measurement
) -> Correction | None:
    """Find exciters whose other resonance clearly explains the observation better.

    Well above the resonance of the magnet on the glued coil, an exciter pushes the plate against
    its magnet with its full force. Far below, the force is small and has the opposite sign. If a
    file states the data sheet's `free` resonance as `mounted`, the exciters appear reversed, and
    weak by a different factor at each frequency. On twelve boards from standard parts, gains left
    by a coarse fit vary over frequency by 0.15 to 0.43 (standard deviation of their logarithms)
    with the right resonance, and by 1.2 or more with the wrong one.
    """
    rig, values = plate.rig, observation.values
    written = {
        name: str(section.values["resonance_is"])
        for name, section in sections_of(rig).items()
        if not section.stiffness
    }
    as_written = _variation(plate, shapes, values) if written else 0.0
    if not as_written > _MAX_VARIATION:
        return None
    for which in dict.fromkeys(written.values()):
        meant = {name: _OTHER_MEANING[which] for name, own in written.items() if own == which}
        other = change_rig(rig, eras={name: {"resonance_is": each} for name, each in meant.items()})
        sensed = plate_of(other, observation)
        found = _variation(sensed, match_shapes(sensed, values), values)
        if found < _CLEARLY_STEADIER * as_written:
            glued = next(e.magnet_frequency for e in exciters_of(other) if e.name in meant)
            details = {
                "which": _OTHER_MEANING[which],
                "as_written": which,
                "factor": math.exp(found),
                "factor_as_written": math.exp(as_written),
            }
            names, changed = ", ".join(meant), {"resonance_is": meant}
            finding = Finding("resonance", names, glued, details=details, json=changed)
            return finding, other, observation
    return None


def _variation(plate: SensedPlate, shapes: ShapeMatch, values: ComplexArray) -> float:
    """Standard deviation over frequency of the logarithm of gains, the median channel's."""
    model = plate.model.at(plate.moved(*shapes.start)).responses[..., shapes.nearest]
    gains = np.abs(gains_of(model, values))
    driven = np.isfinite(gains).sum(axis=0) > 1
    with np.errstate(divide="ignore"):
        sizes = np.log(gains[:, driven])
    return float(np.median(np.nanstd(sizes, axis=0))) if driven.any() else 0.0


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
        """The findings of some kinds."""
        return [each for each in self.findings if each.kind in kinds]

    def about(self, *what: str) -> list[Finding]:
        """The findings about some of what `FindingKind.about` names."""
        return [each for each in self.findings if each.about in what]

    @property
    def wiring_matches(self) -> bool:
        """Whether every driven channel drives its own ERA."""
        return all(set(channel.states) <= {"well", "not driven"} for channel in self.channels)

    @property
    def is_well(self) -> bool:
        """Whether no fault was found."""
        return not any(each.is_fault for each in self.findings)

    @property
    def kept_share(self) -> float | None:
        """Fraction of the table's promises that the plate keeps, None if not compared."""
        return float(np.mean(np.array(self.promise_margins) >= 0)) if self.promise_margins else None


def with_findings(verdict: Verdict) -> Verdict:
    """Return the verdict with the findings that follow from it added."""
    mounts = [  # an ERA that hardly holds the plate
        Finding("detached", each.era, each.value / each.expected)
        for each in verdict.hypotheses[:1]
        if each.era and each.explains and each.value < 0.1 * each.expected
    ]
    found = [*_of_channels(verdict), *_of_plate(verdict), *mounts, *verdict.findings]
    ordered = sorted(found, key=lambda each: _ORDER.index(each.about))
    return replace(verdict, findings=tuple(ordered))


def cycles(channels: Sequence[ChannelVerdict]) -> list[list[ChannelVerdict]]:
    """Cycles of channels that drive each other's ERAs, each from its first channel."""
    by_era = {each.era: each for each in channels}
    found: list[list[ChannelVerdict]] = []
    for channel in channels:
        cycle = [channel]
        while (after := cycle[-1].drives) is not None and by_era[after] not in cycle:
            cycle.append(by_era[after])
        is_known = any(channel in each for each in found)
        if after == channel.era and len(cycle) > 1 and not is_known:
            found.append(cycle)
    return found


def _of_channels(verdict: Verdict) -> Iterator[Finding]:
    """Yield problems of channels, common ones first."""
    channels, swapped = verdict.channels, cycles(verdict.channels)
    for cycle in swapped:
        names, confidence = [each.era for each in cycle], min(each.confidence for each in cycle)
        details = {"one": cycle[0].wiring, "other": cycle[1].wiring}
        details |= {"first": names[0], "second": names[1]}
        kind = "swapped" if len(cycle) == 2 else "cycle"
        yield Finding(kind, ", ".join(names), confidence=confidence, details=details)
    driven = [each for each in channels if each.drives is not None]
    known = {"well", "not driven"}
    for state in ("strong", "weak"):
        gains = {each.era: each.gain for each in driven if state in each.states and each.gain}
        if len(gains) > 1 and len(gains) >= _NEARLY_ALL * len(driven):
            sizes, said = [*gains.values()], {"state": state.upper(), "least": min(gains.values())}
            yield Finding("all strong or weak", ", ".join(gains), max(sizes), details=said)
            known.add(state)
            break
    inverted = ["inverted" in each.states for each in driven]
    if len(inverted) > 1 and all(inverted):
        yield Finding("all inverted", "all")
        known.add("inverted")
    in_cycle = [each for cycle in swapped for each in cycle]
    for each in channels:
        values = {**vars(each), "wiring": each.wiring}
        for state in each.states:
            if state not in known and (state != "other ERA" or each not in in_cycle):
                yield Finding(state, each.era, each.gain or 0.0, each.confidence, details=values)


def _of_plate(verdict: Verdict) -> Iterator[Finding]:
    """Yield differences of the plate from the rig, and the hypotheses that would explain them.

    A loose exciter is named instead. Without differences, outliers are counted.
    """
    match, hypotheses = verdict.match, verdict.hypotheses
    is_loose = any("loose" in each.states for each in verdict.channels)
    if match is None:
        return
    if verdict.plate_matches or is_loose:
        by_sensor = match.outliers.sum(axis=(0, 2))
        if count := int(by_sensor.sum()):
            details = {"count": counted(count, "value")}
            worst = verdict.sensors[best_of(by_sensor)]
            yield Finding("outliers", worst, int(by_sensor.max()), details=details)
        return
    why = f"{percent(match.error)} unexplained at best"
    if match.error <= MAX_FIT_ERROR:
        at = best_of(abs(match.z))
        name = match.plate.rows[at].name
        why = f"{name} would be off by {abs(match.z[at]):.1f} standard deviations"
    good = [each for each in hypotheses if each.explains and each.share >= _MIN_SHARE]
    width = max((len(each.key) for each in good), default=0)
    rows = [
        f"  {each.key:{width}}  {in_display_unit(each.expected, each.unit)} -> "
        f"{in_display_unit(each.value, each.unit)} would explain it: "
        f"{percent(each.match.error)} unexplained, likelihood {percent(each.share)}"
        for each in good
    ]
    if good:
        rows.append(f"  correct {good[0].key} in the rig, or the plate; then check again")
    else:
        rows.append(
            "  no single parameter of the rig would explain it: check plate, positions of sensors "
            "and ERAs, and measure for `era calibrate`"
        )
    details = {"why": why, "hypotheses": "\n".join(rows)}
    yield Finding("plate", good[0].key if good else "", match.worst, details=details)


def match_beyond(match: Match) -> tuple[Match, list[Finding]]:
    """Match a plate again with form errors and loads, and find those beyond tolerances."""
    best, loads = match_with_form(match)
    rig, error = match.plate.rig, {"unexplained": best.error}
    mass = sum(each.mass for each in loads if isinstance(each, PointLoad))
    is_heavy = mass >= _HEAVY * rig.plate.mass
    # A mass within tolerance is not a fault, and neither are form errors that could replace it.
    named = [each for each in loads if is_heavy or isinstance(each, FingertipLoad)]
    if named:
        return best, [_load_finding(each, best.error) for each in named]
    own = {words: best.fit.x[best.fit.space.of(kind)] for kind, words in _FORM.items()}
    own[_THICKNESS], (x, y) = _along_plate(best)
    chances = {
        words: (1 if words == _THICKNESS else len(_FORM)) * float(chdtrc(len(z), z @ z))
        for words, z in own.items()
    }
    farthest = best_by([*chances], lambda words: -chances[words])
    if (chance := chances[farthest]) >= FALSE_ALARM:
        said = {"said": f"{percent(best.error)} of the response is unexplained"}
        unnamed = Finding("unnamed", "response", best.error, details=said, json=error)
        return best, [unnamed] if best.error > MAX_FORM_ERROR else []
    deviation = rms(own[farthest])
    known = {"farthest": farthest, "standard_deviations": deviation, **error}
    if farthest == _THICKNESS:
        along = {"along_x": f"{100 * x:+.1f} %", "along_y": f"{100 * y:+.1f} %"}
        known |= {"thicker_at_end_of_x": x, "thicker_at_end_of_y": y}
        return best, [Finding(_THICKNESS, "ends", deviation, 1.0, chance, along, known)]
    said = {"said": f"{farthest} are off by {deviation:.1f} standard deviations of their tolerance"}
    return best, [Finding("unnamed", farthest, deviation, 1.0, chance, said, known)]


def _load_finding(load: Load, error: float) -> Finding:
    details: dict[str, Any] = {"x_m": load.x, "y_m": load.y}
    mass = load.mass if isinstance(load, PointLoad) else None
    known = {"loads": [{**details, "mass_kg": mass}], "unexplained": error}
    if mass is None:
        return Finding("finger", "plate", details=details, json=known)
    details["grams"] = in_display_unit(mass, "kg")
    return Finding("mass", "plate", mass, details=details, json=known)


def _along_plate(match: Match) -> tuple[FloatArray, tuple[float, float]]:
    """Return the slope of sensor scales along both sides (2,), and the taper that explains it.

    A plate moves more at a thinner end. The slope is in standard deviations, the taper relative at
    the ends of x and of y. The fit's prior reduces scales, so the scales of good plates vary by
    less than their tolerance.
    """
    space, plate, points = match.fit.space, match.plate.rig.plate, match.fit.measurement.points
    own = space.groups["sensor_scale"]
    along = 2 * points / [plate.length, plate.width] - 1
    basis = np.linalg.qr(np.column_stack([np.ones(len(points)), along]))[0][:, 1:]
    shown = np.eye(len(points)) - linearised(match).stated_covariance[own, own]
    shown, rises = basis.T @ shown @ basis + _MIN_SHOWN * np.eye(2), basis.T @ match.fit.x[own]
    thinner = basis @ linalg.solve(shown, rises) * space.std[own]
    x, y = -np.linalg.lstsq(along - along.mean(axis=0), thinner)[0]
    return linalg.solve(linalg.cholesky(shown, lower=True), rises), (float(x), float(y))
