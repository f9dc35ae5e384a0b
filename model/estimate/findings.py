"""What a rig check can find: hypotheses of another plate or wiring, and findings with their texts.

    d_fsn ~ m_fn exp(i phi_fn) a_fsn(x) + noise,   m_fn near G_n

d are measured values, a those of the model, G_n the gain of a channel. Magnitudes m vary about G_n
with frequency as those of real actuators do; phases phi are free, since they need not have been
measured. Both follow from x and G, so that only these are searched (`model.estimate.fit`). Priors
hold x near the rig's values: a large deviation is evidence against the rig.

Which ERA a channel drives follows from the modal assurance criterion (MAC) of shapes: 1 for the
same shape with any gain and phase, about one over the number of sensors for noise. What a file says
the wrong way round (places, grain) is another plate, for which no fit of values makes up. Shapes
show it: those of boards as bought leave a quarter of the response unexplained with the right side,
half to nine tenths with the other.

Where the rig's plate does not fit, each `Hypothesis` varies one value over a range, and the rest of
the rig is fitted within its priors. Where it fits, loads are sought where each would explain most,
and each kind of form error is judged by its sum of squares at an equal share of the false alarms.

A new kind of fault is a function here that returns a `Finding`, which `model.estimate.rig_check`
calls, and its entry in `KINDS`.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy import linalg
from scipy.optimize import linear_sum_assignment, minimize_scalar
from scipy.special import chdtrc, ndtr, stdtr

from model.arrays import ComplexArray, FloatArray, best_by, best_of, ranked_by
from model.errors import InputError
from model.estimate.fit import (
    Fit,
    SensedPlate,
    best_gains,
    fit,
    gains_of,
    plate_of,
    row_rms,
    sensed_plate,
    without_outliers,
)
from model.estimate.identify import solved_for
from model.estimate.measurement import Measurement
from model.finger import Grid
from model.quantities import in_display_unit, percent
from model.rig.rig import Rig
from model.rig.rig_summary import exciters_of, sections_of
from model.spectral.modes import stretched
from model.structure.attachments import Fingertip, FingertipLoad, PointLoad
from model.structure.exciter import Actuator

STARTS = [
    (modulus, stiffness)
    for modulus in np.log(np.linspace(0.6, 1.6, 11)).tolist()
    for stiffness in np.log([0.4, 0.6, 0.8, 1.0, 1.25, 1.6, 2.5]).tolist()
]
"""Logarithms of factors on modulus and stiffnesses from which to search."""

FALSE_ALARM = 0.01
"""Share of plates as written that a test of values, form or thickness calls wrong."""

MAX_FIT_ERROR = 0.2
"""Largest rms error of an acceptable plate, relative to the response."""

MAX_FORM_ERROR = 0.05
"""Largest unexplained share of the responses of a plate that form errors explain."""

MODEL_ERROR = 0.05
"""Error of values relative to their row's rms: scales and places of sensors, what is not modelled.
"""

MIN_COST_REDUCTION = 20.0
"""Reduction of a cost by another wiring or conjugated phases that is clear."""

_GAIN_STD = 0.08  # over frequency, relative
_SOFT = 2.0  # standard deviations
_MAX_OUTLIERS = 0.05  # of all values; of a plate 3 % longer than its rig's a tenth look like some
_MIN_CONFIDENCE = 0.99  # in another ERA than the rig's
_LEAST_MISFIT = 0.02  # below it sensors' errors dominate

_OWN_PLACE, _OTHER_PLACE = 0.8, 0.9  # coherence of an exchanged sensor, at most and at least
_MAX_COARSE_ERROR = 0.45  # of a coarse fit of the right board that has a fault
_CLEARLY_LESS = 0.6  # of the error as written
_OTHER_MEANING = {"free": "mounted", "mounted": "free"}
_MAX_VARIATION = 0.8  # standard deviation of logarithms of gains; no drive has more
_CLEARLY_STEADIER = 0.5  # of the variation as written

_SIZES = (0.6, 0.67, 0.75, 0.82, 0.88, 0.94, 1.06, 1.13, 1.21, 1.33, 1.5, 1.67)
_STIFFNESSES = (0.01, 0.03, 0.1, 0.2, 0.35, 0.5, 0.65, 0.8, 1.25, 1.5, 2.0, 3.0, 5.0, 10.0, 30.0)
_FITTED = 5  # hypotheses for which the rest of the rig is fitted
_REFINED = 2  # of these, whose value is refined
_REFINEMENTS = 7  # values
_CORRELATION = 4.0  # errors of a model are correlated over sensors and frequencies
_MIN_SHARE = 0.05  # likelihood of a reported hypothesis

_NOISE = (0.01, 0.05)  # of a row's rms: least and largest that a fit with form is weighted by
_FIRST_NOISE = 0.02
_LOAD_GRID = Grid(32, 24)  # where loads are sought
_MAX_LOADS = 2
_HEAVY = 0.02  # of the plate's mass, all masses together: twice the tolerance of foreign mass
_LIGHT, _FIRM = 0.3, 3.0  # of a fingertip
_CLEAR_LOAD = 40.0  # reduction of half the sum of squares
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
    """Its line, filled in with the fields and details of a finding: what is wrong, what to do."""
    about: str = "channel"
    """What it is about: `file` (what the rig's file says the wrong way round), `channel`, `sensor`
    (which is left out), `plate`, `load` (what lies on the plate) or `form` (a deviation that no key
    of a rig names)."""
    is_fault: bool = True
    """Whether it fails the check."""


KINDS = {
    "mirrored": FindingKind(
        "PLACES: places of sensors must be from the corner from which those of ERAs are, "
        "got ones mirrored in {of}: {coarse}; correct the positions of all{or_plugs}",
        "file",
    ),
    "reversed": FindingKind(
        "PLACES: frequencies must be those of their responses, got reversed ones: {coarse}", "file"
    ),
    "exchanged": FindingKind(
        "PLACES: sensors must be at their places, got responses that fit exchanged ones: "
        "{of}; correct their positions or names",
        "file",
    ),
    "grain": FindingKind(
        "GRAIN: plate.grain must be {along}, got {as_written}: with the grain along its {along} a "
        "coarse fit leaves {percent} of the responses unexplained, along its {as_written} "
        "{percent_as_written}; look at the veneer of its faces, and correct the rig",
        "file",
    ),
    "resonance": FindingKind(
        "RESONANCE: resonance_is of {of} must be {which}, got {as_written}: with it "
        "{which} a glued magnet resonates at {value:.0f} Hz, and gains vary by a factor of "
        "{factor:.2g} over frequency, as written by {factor_as_written:.2g}; correct the rig",
        "file",
    ),
    "swapped": FindingKind(
        "SWAPPED: {one} drives ERA {second}, and {other} drives ERA {first} (confidence "
        "{confidence:.3f}): exchange the two plugs, or the channels in the rig"
    ),
    "cycle": FindingKind(
        "SWAPPED in a cycle: the channels of {of} each drive the next one's ERA (confidence "
        "{confidence:.3f}): correct the plugs"
    ),
    "all strong or weak": FindingKind(
        "{state}: the channels of {of} play {least:.2f} to {value:.2f} of the "
        "commanded amplitude: check the sensors' sensitivity first, which makes all of them so "
        "together; then the amplifier's volume"
    ),
    "all inverted": FindingKind(
        "INVERTED: all channels have the sign that is opposite to the sensors': turn "
        "the sensors over, swap the two wires of every ERA, or check the sign convention of phases"
    ),
    "dead": FindingKind(
        "DEAD: {wiring} does not move the plate: check its supply, its cable and the "
        "amplifier's channel"
    ),
    "loose": FindingKind(
        "LOOSE: {wiring} acts on the plate with a part of its contact only, as an exciter "
        "whose glue is off: press it on or glue it anew, and measure again"
    ),
    "weak": FindingKind(
        "WEAK: {wiring} plays {value:.2f} of the commanded amplitude: check its voltage, "
        "volume and mounting, or measure its gain with `era calibrate`"
    ),
    "strong": FindingKind(
        "STRONG: {wiring} plays {value:.2f} of the commanded amplitude: lower its voltage or "
        "volume, or correct its stroke or gains in the rig"
    ),
    "other ERA": FindingKind(
        "WRONG ERA: {wiring} drives ERA {drives} instead of {of} (MAC {mac_found:.3f}, with its "
        "own ERA {mac_own:.3f}; confidence {confidence:.3f}): correct the plug, or the rig's "
        "channels"
    ),
    "inverted": FindingKind(
        "INVERTED: {wiring} has the opposite sign of the others: swap its two wires"
    ),
    "out of phase": FindingKind(
        "OUT OF PHASE: {wiring} is off by {phase:+.0f}°: measure its gains with `era calibrate`"
    ),
    "silent": FindingKind("SENSOR {of} reads nothing: left out", "sensor", is_fault=False),
    "mute": FindingKind(
        "SENSOR {of} reads {value:.2f} of what the others say: check that it is where its line "
        "says, and its cable: left out",
        "sensor",
        is_fault=False,
    ),
    "upside down": FindingKind(
        "SENSOR {of} is upside down (reads {value:.2f} of what the others say): turn it "
        "over: left out",
        "sensor",
        is_fault=False,
    ),
    "off scale": FindingKind(
        "SENSOR {of} reads {value:.2f} of what the others say: left out", "sensor", is_fault=False
    ),
    "plate": FindingKind("PLATE: the rig does not match the plate: {why}\n{hypotheses}", "plate"),
    "outliers": FindingKind(
        "OUTLIERS: {count} left out, {value} of them of sensor {of}: check for loose "
        "contacts if they are many",
        "plate",
        is_fault=False,
    ),
    "mass": FindingKind(
        "MASS: {grams} at ({x_m:.2f}, {y_m:.2f}) m: remove it, or write it to the rig's masses",
        "load",
    ),
    "finger": FindingKind(
        "FINGER: the plate is touched at ({x_m:.2f}, {y_m:.2f}) m: take away what rests "
        "there, and measure again",
        "load",
    ),
    "thickness": FindingKind(
        "THICKNESS: the plate is {along_x} thicker at the end of x and {along_y} at that "
        "of y than in its middle, by what its sensors read: check it, or the sensors' scales",
        "form",
    ),
    "unnamed": FindingKind(
        "UNNAMED: the plate is as written, but for something that has no name here: {said}; "
        "check its thickness, what is bonded to it and the sensors' scales, and measure for `era "
        "calibrate`",
        "form",
    ),
    "promise": FindingKind(
        "PROMISE: half of the answers of the rig's table miss the contrast that it promises "
        "by {value:.1f} dB or more",
        "plate",
    ),
}
"""Every kind of finding by its name."""

Load: TypeAlias = PointLoad | FingertipLoad
"""What may lie on a plate."""


@dataclass(frozen=True)
class Finding:
    """Something that a check found."""

    kind: str
    """Key of `KINDS`."""
    of: str
    """What it is of, by name."""
    value: float = 0.0
    """How large it is, as its text says."""
    confidence: float = 1.0
    """Confidence 0..1 in it."""
    chance: float = 1.0
    """Share of plates as written that look as far off or further."""
    details: Mapping[str, Any] = field(default_factory=dict)
    """Further values, of which the text is made."""
    json: Mapping[str, Any] = field(default_factory=dict)
    """What it adds to the JSON of the plate: of a `file` its key, of a load or form what is known
    of it."""

    @property
    def about(self) -> str:
        """What it is about, as `FindingKind.about`."""
        return KINDS[self.kind].about

    @property
    def rows(self) -> list[str]:
        """Lines for people: what is wrong, and what to do."""
        own = {"of": self.of, "value": self.value, "confidence": self.confidence}
        return KINDS[self.kind].text.format(**{**self.details, **own}).splitlines()

    @property
    def problem(self) -> str:
        """What is wrong with a sensor, in a few words."""
        return self.rows[0].removeprefix(f"SENSOR {self.of} ").removesuffix(": left out")

    @property
    def is_fault(self) -> bool:
        """Whether it fails the check."""
        return KINDS[self.kind].is_fault


@dataclass(frozen=True, eq=False)
class Match:
    """The best fit of a plate to values of channels."""

    plate: SensedPlate
    """The plate of the rig before the fit."""
    fit: Fit
    """Its fit, of values relative to the level of each channel."""
    gains: FloatArray
    """Magnitude of the gain of each channel (n,), NaN if not used."""
    shares: FloatArray
    """Residuals relative to the rms of their row (m,)."""
    predicted: ComplexArray
    """Measurement of the ERAs that the channels drive, with gains (f, s, n)."""
    outliers: NDArray[np.bool_]
    """Mask of values that no error counts (f, s, n)."""
    model_error: float
    """Error of the model by which the values were weighted, relative to the rms of their row."""

    @cached_property
    def rig(self) -> Rig:
        """The rig with the fitted values."""
        return self.plate.rig_at(self.fit.x)

    @cached_property
    def z(self) -> FloatArray:
        """Deviation of each fitted value (n,), as `SensedPlate.deviations`."""
        return self.plate.deviations(self.fit.x)

    @cached_property
    def responses(self) -> ComplexArray:
        """Measurement of the ERAs, without gains (f, s, n)."""
        model = self.plate.model
        return model.at(np.where(model.space.of("gain"), 0.0, self.fit.x)).responses

    @property
    def error(self) -> float:
        """Rms of the residuals relative to the rms of their row."""
        return math.sqrt(float((self.shares**2).mean())) if len(self.shares) else math.inf

    @property
    def median_error(self) -> float:
        """Median of the same."""
        return float(np.median(self.shares)) if len(self.shares) else math.inf

    @property
    def worst(self) -> float:
        """The largest of |z|."""
        return float(np.abs(self.z).max())

    @property
    def chance(self) -> float:
        """Upper limit of the share of plates as written with a value at least as far off."""
        return float(2 * len(self.z) * ndtr(-self.worst))


def match_plate(
    plate: SensedPlate,
    values: ComplexArray,
    *,
    drives: Sequence[int],
    model_error: float = MODEL_ERROR,
    starts: Sequence[tuple[float, float]] = ((0.0, 0.0),),
) -> Match:
    """Fit a rig's plate at sensors to values (f, s, n) of channels.

    drives (n,): number of the ERA that each channel drives; model_error: relative to a row's rms;
    starts: logarithms of factors on the modulus and on all stiffnesses from which to search.
    """
    model, driven = plate.model, list(drives)
    known = np.isfinite(values)
    rows: NDArray[np.bool_] = np.asarray(known.any(axis=1))
    used = rows.any(axis=0)
    own = np.array(model.space.indices("gain"))[driven]
    searched = model.space.uncertain & ~model.space.of("gain")
    searched[own[used]] = True
    std, tried = model.space.std[own], []
    for start in starts:
        at = plate.moved(*start)
        predicted = np.where(known, model.at(at).responses[..., driven], np.nan)
        ratio = np.log(np.maximum(row_rms(values) / row_rms(predicted), 1e-6))[:, 0]
        levels = np.array(
            [
                np.median(each[row]) if row.any() else 0.0
                for each, row in zip(ratio.T, rows.T, strict=True)
            ]
        )
        at[own[used]] = (levels / std)[used]
        # Two channels may drive one ERA: each has its own level beside the gain of the last one.
        beside = np.where(used, levels - std * at[own], 0.0)
        scaled = values / np.exp(beside)
        errors = model_error * np.broadcast_to(row_rms(scaled), scaled.shape)
        measured = Measurement(
            model.sensors,
            model.frequencies,
            scaled,
            errors,
            gain_std=_GAIN_STD,
            drives=tuple(driven),
        )
        tried.append((fit(model, measured, searched=searched, start=at, soft=_SOFT), beside))
    best, beside = best_by(tried, lambda each: -each[0].cost)
    predicted = best.plate.responses[..., driven]
    outliers = _outliers(values, predicted)
    kept = np.where(outliers, np.nan, best.measurement.values)
    errors = np.broadcast_to(row_rms(kept), kept.shape)
    none = np.zeros((*kept.shape, 0))
    left = best_gains(
        predicted, none, replace(best.measurement, values=kept, errors=model_error * errors)
    )[2]
    return Match(
        plate,
        best,
        np.where(used, np.exp(beside + std * best.x[own]), np.nan),
        model_error * np.abs(left),
        np.where(used, predicted * np.exp(beside), np.nan),
        outliers,
        model_error,
    )


def _outliers(values: ComplexArray, predicted: ComplexArray) -> NDArray[np.bool_]:
    """Mask of the values (f, s, n) that a calibration would leave out as outliers.

    Empty where they are too many, and for a sensor most of whose values they are: such values are
    not accidental, but show that the plate, its wiring or the sensor's place is another one.
    """
    known = np.isfinite(values)
    found = known & ~np.isfinite(without_outliers(values, predicted)[0])
    found[:, found.sum(axis=(0, 2)) > known.sum(axis=(0, 2)) / 2] = False
    return found & bool(found.sum() <= _MAX_OUTLIERS * known.sum())


def modal_assurance(values: ComplexArray, model: ComplexArray) -> FloatArray:
    """Modal assurance criterion |a^H d|² / (|a|² |d|²) of shapes (..., s); NaN of empty ones.

    1 for the same shape with any gain, about 1/s for noise. Values that are not finite are ignored.
    """
    measured = np.isfinite(values)
    values = np.where(measured, values, 0)
    model = np.where(measured, model, 0)
    inner = np.abs((model.conj() * values).sum(axis=-1)) ** 2
    power = (np.abs(values) ** 2).sum(axis=-1) * (np.abs(model) ** 2).sum(axis=-1)
    return np.where(power > 0, inner / np.where(power > 0, power, 1), np.nan)


@dataclass(frozen=True, eq=False)
class ShapeMatch:
    """MAC of channels and ERAs on the most similar plate."""

    mac: FloatArray
    """MAC (f, n, n) of the channel that the rig wires to the first ERA with the second ERA, NaN if
    not driven."""
    start: tuple[float, float] = (0.0, 0.0)
    """Logarithms of that plate's factors on modulus and stiffnesses."""

    @property
    def starts(self) -> tuple[tuple[float, float], ...]:
        """Logarithms of factors from which to search: 0, and those of that plate."""
        return tuple(dict.fromkeys([(0.0, 0.0), self.start]))

    @cached_property
    def medians(self) -> FloatArray:
        """Medians of the MAC over frequency (n, n)."""
        ordered, count = np.sort(self.mac, axis=0), np.isfinite(self.mac).sum(axis=0)
        low = np.take_along_axis(ordered, np.maximum(count - 1, 0)[None] // 2, axis=0)
        high = np.take_along_axis(ordered, count[None] // 2, axis=0)  # NaN without any
        return np.asarray((low[0] + high[0]) / 2)

    @cached_property
    def nearest(self) -> list[int]:
        """Index of the ERA most similar to each channel; its own if not driven."""
        return [
            best_of(np.nan_to_num(row, nan=-1.0)) if np.isfinite(row).any() else number
            for number, row in enumerate(self.medians)
        ]

    def error(self, eras: Sequence[int]) -> float:
        """Share of the responses, rms, that the shapes of some ERAs (n,) leave unexplained."""
        alike = self.mac[:, range(self.mac.shape[1]), list(eras)]
        left = 1 - alike[np.isfinite(alike)]
        return math.sqrt(max(0.0, float(left.mean()))) if len(left) else math.inf

    def confidence(self, channel: int, era: int, other: int) -> float:
        """Confidence 0..1 that the channel drives one ERA and not the other.

        By Student's t-test of the difference of their misfits over frequencies.
        """
        misfit = np.log(np.maximum(1 - self.mac[:, channel], _LEAST_MISFIT))
        gain = misfit[:, other] - misfit[:, era]
        gain = gain[np.isfinite(gain)]
        if len(gain) < 3 or np.ptp(gain) == 0:
            return 0.5
        t = gain.mean() * np.sqrt(len(gain)) / gain.std(ddof=1)
        return float(stdtr(len(gain) - 1, t))


def match_responses(
    model: ComplexArray, values: ComplexArray, start: tuple[float, float] = (0.0, 0.0)
) -> ShapeMatch:
    """Compare values (f, s, n) with responses (f, s, n) of one plate."""
    model, values = model.swapaxes(1, 2), values.swapaxes(1, 2)
    return ShapeMatch(modal_assurance(values[:, :, None], model[:, None]), start)


def match_shapes(plate: SensedPlate, values: ComplexArray) -> ShapeMatch:
    """Compare values (f, s, n) with a rig's ERAs on plates of other modulus and stiffnesses."""

    def score(found: ShapeMatch) -> float:
        alike = [found.medians[number, era] for number, era in enumerate(found.nearest)]
        # Values far from the rig's must be clearly better.
        return float(np.nansum(alike) - 0.05 * sum(map(abs, found.start)) * len(alike))

    tried = [
        match_responses(plate.model.at(plate.moved(*start)).responses, values, start)
        for start in [(0.0, 0.0), *STARTS]
    ]
    return best_by(tried, score)


def best_wiring(
    plate: SensedPlate, values: ComplexArray, shapes: ShapeMatch
) -> tuple[Match, list[int]]:
    """Best plate and wiring for values (f, s, n): the rig's unless another is clearly better.

    shapes: match of the values with the plate.
    """
    own = [*range(values.shape[2])]
    nearest = [
        era if era == n or shapes.confidence(n, era, n) >= _MIN_CONFIDENCE else n
        for n, era in enumerate(shapes.nearest)
    ]
    found = [
        (match_plate(plate, values, drives=drives, starts=shapes.starts), drives)
        for drives in ([own] if nearest == own else [own, nearest])
    ]
    return best_by(found, lambda each: -each[0].fit.cost - MIN_COST_REDUCTION * (each[1] != own))


def reversed_axes(
    plate: SensedPlate, shapes: ShapeMatch, observation: Measurement, *, may_be_plugs: bool
) -> tuple[Finding, Rig, Measurement] | None:
    """Find the axes along which a measurement is noted the wrong way round, and note it right.

    Channels drive the ERAs of the rig. shapes: match of the observation with the rig's plate;
    may_be_plugs: whether exchanged channels may explain the observation as well.
    """
    rig, as_written = plate.rig, shapes.error(range(len(shapes.mac[0])))
    if not as_written > _MAX_COARSE_ERROR:
        return None
    tried = []
    for axes in (("x",), ("y",), ("x", "y"), ("frequency",)):
        size = np.array([rig.plate.length, rig.plate.width])
        points = np.abs(size * [axis in axes for axis in "xy"] - observation.points)
        values = observation.values[:: -1 if axes == ("frequency",) else 1]
        right = replace(observation.moved(points), values=values)
        found = match_shapes(plate_of(rig, right), values)
        tried.append((found.error(range(len(found.mac[0]))), axes, right))
    error, axes, right = best_by(tried, lambda each: -each[0])
    are_plugs = shapes.error(shapes.nearest) * _CLEARLY_LESS < error
    too_large = error >= min(_MAX_COARSE_ERROR, _CLEARLY_LESS * as_written)
    if too_large or (are_plugs and not may_be_plugs):
        return None
    names = " and ".join(axes)
    coarse = (
        f"with {names} from the other end a coarse fit leaves {percent(error)} of the "
        f"responses unexplained, as written {percent(as_written)}"
    )
    or_plugs = ", or plug the channels as the rig has them" if are_plugs else ""
    kind = "reversed" if axes == ("frequency",) else "mirrored"
    details, changed = {"coarse": coarse, "or_plugs": or_plugs}, {"reversed_axes": [*axes]}
    return Finding(kind, names, details=details, json=changed), rig, right


def exchanged_sensors(
    observation: Measurement, model: ComplexArray, values: ComplexArray
) -> tuple[Finding, Measurement] | None:
    """Find sensors whose values (f, s, n) are those of a model at another's place."""
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
    return found, observation.moved(points)


def other_meaning(
    plate: SensedPlate, shapes: ShapeMatch, observation: Measurement
) -> tuple[Finding, Rig] | None:
    """Find a value that the rig of a plate has the wrong way round, the grain first.

    shapes: match of the observation with that plate. None if neither is clearly wrong, else the
    finding and the rig that is put right.
    """
    return turned_grain(plate, shapes, observation) or misread_resonance(plate, shapes, observation)


def turned_grain(
    plate: SensedPlate, shapes: ShapeMatch, observation: Measurement
) -> tuple[Finding, Rig] | None:
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
    found: dict[str, Any] = {"expected": rig.grain, "found": along}
    found |= {"unexplained": error, "unexplained_as_written": as_written}
    details = {
        "along": along,
        "as_written": rig.grain,
        "percent": percent(error),
        "percent_as_written": percent(as_written),
    }
    return Finding("grain", "plate.grain", details=details, json={"grain": found}), turned


def misread_resonance(
    plate: SensedPlate, shapes: ShapeMatch, observation: Measurement
) -> tuple[Finding, Rig] | None:
    """Find exciters whose other resonance clearly explains the observation better.

    An exciter pushes a plate against its magnet, well above the resonance of the magnet on the
    glued coil with its whole force, far below it hardly, and with the opposite sign. A file that
    takes a sheet's `free` resonance for the `mounted` one thus describes exciters that all look
    reversed, and weak by another factor at each frequency. On twelve boards as bought the gains
    left by a coarse fit vary over frequency by 0.15 to 0.43 (standard deviation of their
    logarithms) with the right meaning, and by 1.2 or more with the other.
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
        other = rig.replaced(eras={name: {"resonance_is": each} for name, each in meant.items()})
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
            changed = {"resonance_is": meant}
            finding = Finding("resonance", ", ".join(meant), glued, details=details, json=changed)
            return finding, other
    return None


def _variation(plate: SensedPlate, shapes: ShapeMatch, values: ComplexArray) -> float:
    """Standard deviation over frequency of the logarithm of gains, the median channel's."""
    model = plate.model.at(plate.moved(*shapes.start)).responses[..., shapes.nearest]
    gains = np.abs(gains_of(model, values))
    driven = np.isfinite(gains).sum(axis=0) > 1
    with np.errstate(divide="ignore"):
        sizes = np.log(gains[:, driven])
    return float(np.median(np.nanstd(sizes, axis=0))) if driven.any() else 0.0


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """Another plate: one value of the rig differs, and the rest is fitted."""

    key: str
    """Key of the value in the rig file."""
    unit: str
    expected: float
    """Value in the rig."""
    value: float
    """Value that explains the measurement best."""
    match: Match
    """The plate with that value."""
    share: float
    """Share 0..1 of the likelihood among all hypotheses."""

    @property
    def era(self) -> str:
        """Name of the only ERA whose value it is, "" for another value."""
        return self.key[len("eras.") :].rpartition(".")[0]

    @property
    def explains(self) -> bool:
        """Whether the rest of the rig is within its priors."""
        return self.match.error <= MAX_FIT_ERROR and self.match.chance >= FALSE_ALARM


def ranges(rig: Rig) -> dict[str, tuple[str, tuple[float, ...]]]:
    """Units of the values of a rig that may be other ones, and the factors to try, by key."""
    of_eras = {f"eras.{era.name}.stiffness": ("N/m", _STIFFNESSES) for era in rig.eras}
    return {
        **{f"plate.{name}": ("m", _SIZES) for name in ("thickness", "length", "width")},
        "plate.material.E": ("Pa", tuple(size**2 for size in _SIZES)),
        "plate.loss_factor": ("", (0.1, 0.3, 3.0, 10.0, 30.0)),
        "eras.stiffness": ("N/m", _STIFFNESSES),
        "eras.bolt_mass": ("kg", (0.01, 0.02, 0.04, 0.08, 0.16)),
        **of_eras,
    }


def _value(rig: Rig, key: str) -> float:
    """The value of a key in a rig, of all ERAs their mean."""
    owner, _, name = key.rpartition(".")
    if not key.startswith("eras"):
        return float(rig.plate.material.E if name == "E" else getattr(rig.plate, name))
    eras = [era for era in rig.eras if owner in ("eras", f"eras.{era.name}")]
    return float(np.mean([getattr(era, era.fields[name]) for era in eras]))


def _varied(rig: Rig, key: str, factor: float) -> Rig:
    """The rig with another value of a key, of bolts by a share of the plate's mass.

    Raises InputError for a value that it cannot have.
    """
    plate, (owner, _, name) = rig.plate, key.rpartition(".")
    if name in ("thickness", "E"):
        return replace(rig, plate=plate.scaled(**{"modulus" if name == "E" else name: factor}))
    if name == "loss_factor":
        return replace(rig, plate=replace(plate, loss_factor=min(plate.loss_factor * factor, 0.9)))
    if name in ("length", "width"):
        # With everything attached in proportion.
        x, y = (factor, 1.0) if name == "length" else (1.0, factor)
        plate = replace(plate, length=plate.length * x, width=plate.width * y)
        eras = tuple(replace(era, x=era.x * x, y=era.y * y) for era in rig.eras)
        masses = tuple(replace(each, x=each.x * x, y=each.y * y) for each in rig.masses)
        mesh = stretched(rig.mesh, plate)
        return replace(rig, plate=plate, eras=eras, masses=masses, mesh=mesh)

    def changed(era: Actuator) -> Actuator:
        if owner not in ("eras", f"eras.{era.name}"):
            return era
        if name == "stiffness":
            return era.varied(stiffness=factor) if owner == "eras" else era.loosened(factor)
        bolt = era.fields["bolt_mass"]
        return replace(era, **{bolt: getattr(era, bolt) + factor * plate.mass})

    return replace(rig, eras=tuple(changed(era) for era in rig.eras))


def compared(
    plate: SensedPlate,
    observation: Measurement,
    values: ComplexArray,
    *,
    drives: Sequence[int],
    model_error: float,
) -> list[Hypothesis]:
    """Find which other plates explain values (f, s, n) best, most likely first.

    See `match_plate`. One value is varied at once; density, which is the inverse of the modulus and
    of stiffnesses, is not.
    """
    rig, of = plate.rig, ranges(plate.rig)

    def solved(key: str, factor: float) -> SensedPlate | None:
        try:
            other = _varied(rig, key, factor)
        except InputError:
            return None
        if key not in ("plate.length", "plate.width"):
            return plate.of(other)
        # A sensor that would be off the plate counts as at its edge.
        points = np.clip(observation.points, 0, [other.plate.length, other.plate.width])
        return sensed_plate(other, observation.moved(points).sensors, observation.frequencies)

    def matched(key: str, factor: float) -> Match | None:
        if other := solved(key, factor):
            return match_plate(other, values, drives=drives, model_error=model_error)
        return None

    scores = []
    for key, (_, factors) in of.items():
        for factor in factors:
            if other := solved(key, factor):
                scores.append((_misfit(values, other.responses()[..., list(drives)]), factor, key))
    best = {key: (score, factor) for score, factor, key in ranked_by(scores, lambda each: each[0])}
    fits = []
    for key, (_, factor) in ranked_by([*best.items()], lambda each: -each[1][0])[:_FITTED]:
        match = matched(key, factor)
        if match is not None:
            fits.append((key, factor, match))
    fits = ranked_by(fits, lambda each: -each[2].fit.cost)
    for number, (key, factor, match) in enumerate(fits[:_REFINED]):
        refined = _refined(of[key][1], factor, match, partial(matched, key))
        fits[number] = (key, *refined)
    costs = np.array([match.fit.cost for _, _, match in fits])
    weights = np.exp(-(costs - costs.min()) / _CORRELATION)
    found = [
        Hypothesis(key, of[key][0], _value(rig, key), _value(match.rig, key), match, float(share))
        for (key, _, match), share in zip(fits, weights / weights.sum(), strict=True)
    ]
    return ranked_by(found, lambda each: each.share)


def _refined(
    factors: Sequence[float],
    factor: float,
    match: Match,
    matched: Callable[[float], Match | None],
) -> tuple[float, Match]:
    """Search for the best factor between the neighbours of one in a range."""
    padded = (factors[0] / 1.5, *factors, factors[-1] * 1.5)
    at, known = 1 + factors.index(factor), {factor: match}

    def cost(logarithm: float) -> float:
        tried = matched(math.exp(logarithm))
        if tried is None:
            return match.fit.cost * 1e3
        known[math.exp(logarithm)] = tried
        return tried.fit.cost

    minimize_scalar(
        cost,
        bounds=(math.log(padded[at - 1]), math.log(padded[at + 1])),
        method="bounded",
        options={"maxiter": _REFINEMENTS, "xatol": 3e-3},
    )
    return best_by([*known.items()], lambda each: -each[1].fit.cost)


def _misfit(values: ComplexArray, model: ComplexArray) -> float:
    """Difference of shapes and, up to a gain of each channel, of magnitudes; 0 if equal."""
    mac = modal_assurance(values.swapaxes(1, 2), model.swapaxes(1, 2))
    known = np.isfinite(values)
    driven = known.any(axis=(0, 1))
    ratio = np.log(row_rms(values) / row_rms(np.where(known, model, np.nan)))[:, 0, driven]
    deviation = np.minimum(np.abs(ratio - np.nanmedian(ratio, axis=0)), 1.0)
    return float(np.nanmean(1 - mac) + 0.5 * np.nanmean(deviation))


def plate_finding(match: Match, hypotheses: Sequence[Hypothesis]) -> Finding:
    """Say how the plate differs from the rig, and which hypotheses would explain it."""
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
    return Finding("plate", good[0].key if good else "", match.worst, details=details)


def match_with_form(
    plate: SensedPlate, observation: Measurement, values: ComplexArray, drives: Sequence[int]
) -> tuple[Match, list[Finding]]:
    """Match values (f, s, n) of channels with a plate with form errors and loads.

    Form errors explain what builders and rulers do, but not a mass in one place near an edge.
    Returns the match, and what of the plate is beyond tolerances.
    """

    def matched(loads: Sequence[Load], noise: float) -> Match:
        rig = replace(plate.rig, masses=(*plate.rig.masses, *loads))  # type: ignore[arg-type]
        sensed = plate_of(rig, observation, has_form=True)
        return match_plate(sensed, values, drives=drives, model_error=noise)

    noise = float(np.clip(matched((), _FIRST_NOISE).error, *_NOISE))
    best = matched((), noise)
    loads: list[Load] = []
    further, linearised = _loads(best, values, drives, noise)
    while further and len(loads) < _MAX_LOADS:
        tried = [(each, matched((*loads, each), noise)) for each in further]
        load, found = best_by(tried, lambda each: -each[1].fit.cost)
        if found.fit.cost > best.fit.cost - _CLEAR_LOAD:
            break
        best, loads = found, [*loads, load]
        further, linearised = _loads(best, values, drives, noise)
    mass = sum(each.mass for each in loads if isinstance(each, PointLoad))
    is_heavy = mass >= _HEAVY * plate.rig.plate.mass
    # A mass within tolerance is no fault, nor are form errors that would stand in for it.
    named = [each for each in loads if is_heavy or isinstance(each, FingertipLoad)]
    if named:
        return best, [_load_finding(each, best.error) for each in named]
    own = {words: best.fit.x[best.plate.model.space.of(kind)] for kind, words in _FORM.items()}
    own[_THICKNESS], (x, y) = _along_plate(best, observation.points, linearised)
    chances = {
        words: (1 if words == _THICKNESS else len(_FORM)) * float(chdtrc(len(z), z @ z))
        for words, z in own.items()
    }
    farthest = best_by([*chances], lambda words: -chances[words])
    chance, error = chances[farthest], {"unexplained": best.error}
    if chance >= FALSE_ALARM:
        said = {"said": f"{percent(best.error)} of the response is unexplained"}
        unnamed = Finding("unnamed", "response", best.error, details=said, json=error)
        return best, [unnamed] if best.error > MAX_FORM_ERROR else []
    deviation = float(np.sqrt((own[farthest] ** 2).mean()))
    known = {"farthest": farthest, "standard_deviations": deviation, **error}
    if farthest == _THICKNESS:
        along = {"along_x": f"{100 * x:+.1f} %", "along_y": f"{100 * y:+.1f} %"}
        known |= {"thicker_at_end_of_x": x, "thicker_at_end_of_y": y}
        return best, [Finding(_THICKNESS, "ends", deviation, 1.0, chance, along, known)]
    said = {"said": f"{farthest} are off by {deviation:.1f} standard deviations of their tolerance"}
    return best, [Finding("unnamed", farthest, deviation, 1.0, chance, said, known)]


def _load_finding(load: Load, error: float) -> Finding:
    at, known = {"x_m": load.x, "y_m": load.y}, {"unexplained": error}
    if isinstance(load, FingertipLoad):
        place = {**at, "mass_kg": None}
        return Finding("finger", "plate", details=at, json={"loads": [place], **known})
    place = {**at, "mass_kg": load.mass}
    details = {**at, "grams": in_display_unit(load.mass, "kg")}
    return Finding("mass", "plate", load.mass, details=details, json={"loads": [place], **known})


def _along_plate(
    match: Match, points: FloatArray, linearised: Fit
) -> tuple[FloatArray, tuple[float, float]]:
    """Rise of the scales of sensors along both sides (2,), and the taper that explains it.

    A plate that is thinner at one end moves more there. The rise is in standard deviations, the
    taper relative at the ends of x and of y. The prior of a fit reduces scales, so that those of
    sound plates vary by less than their tolerance.
    """
    space, plate = match.plate.model.space, match.plate.rig.plate
    own = space.groups["sensor_scale"]
    along = 2 * points / [plate.length, plate.width] - 1
    basis = np.linalg.qr(np.column_stack([np.ones(len(points)), along]))[0][:, 1:]
    shown = np.eye(len(points)) - linearised.stated_covariance[own, own]
    shown, rises = basis.T @ shown @ basis + _MIN_SHOWN * np.eye(2), basis.T @ match.fit.x[own]
    thinner = basis @ linalg.solve(shown, rises) * space.std[own]
    x, y = -np.linalg.lstsq(along - along.mean(axis=0), thinner)[0]
    return linalg.solve(linalg.cholesky(shown, lower=True), rises), (float(x), float(y))


def _loads(
    match: Match, values: ComplexArray, drives: Sequence[int], noise: float
) -> tuple[list[Load], Fit]:
    """A mass and a finger where each would explain most, and the linearised match beside them.

    A finger lighter than a share of a fingertip is skipped. Gains are free at every frequency.
    """
    model, rig = match.plate.model, match.plate.rig
    kept = np.where(match.outliers, np.nan, values)
    errors = np.broadcast_to(noise * row_rms(kept), kept.shape)
    measured = replace(match.fit.measurement, values=kept, errors=errors, gain_std=math.inf)
    searched = model.space.uncertain & ~model.space.of("gain")
    linearised = fit(model, measured, searched=searched, start=match.fit.x, evaluations=1)
    points, tip = _LOAD_GRID.centres(rig.plate), rig.fingertip or Fingertip()
    found: list[Load] = []
    for number, mass in linearised.loads(points, std=rig.plate.mass)[:1]:
        x, y = points[number].tolist()
        found.append(PointLoad(x, y, mass=mass))
    factor = -tip.dynamic_stiffness(model.omega) / model.omega**2
    for number, size in linearised.loads(points, factor=factor)[:1]:
        if size >= _LIGHT:
            x, y = points[number].tolist()
            found.append(FingertipLoad(x, y, tip.multiplied(min(size, _FIRM))))
    return found, linearised
