"""Find the plate and wiring that explain the measured values of channels best.

    d_fsn ~ m_fn exp(i phi_fn) a_fsn(x) + noise,   m_fn near G_n

d are measured values, a the model's values, G_n the gain of a channel. Magnitudes m vary about G_n
with frequency, like those of real actuators. Phases phi are free, because a measurement can lack
them. Both follow from x and G, so that only these are searched (`model.estimate.fit`). Priors hold
x near the rig's values: a large deviation is evidence against the rig.

The ERA that a channel drives is identified by the modal assurance criterion (MAC) of shapes: 1 for
the same shape with any gain and phase, about one over the number of sensors for noise.

If the rig's plate does not fit, each `Hypothesis` varies one value over a range, and the rest of
the rig is fitted within its priors. If it fits, loads are searched at the positions where they
would explain most.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar
from scipy.special import ndtr, stdtr

from model.arrays import ComplexArray, FloatArray, best_by, best_of, ranked_by, rms
from model.errors import InputError
from model.estimate.fit import (
    Fit,
    SensedPlate,
    best_gains,
    fit,
    plate_of,
    row_rms,
    sensed_plate,
    without_outliers,
)
from model.estimate.measurement import Measurement
from model.finger import Grid
from model.rig.rig import Rig
from model.spectral.modes import stretched
from model.structure.attachments import Fingertip, FingertipLoad, PointLoad
from model.structure.exciter import Actuator

STARTS = [
    (modulus, stiffness)
    for modulus in np.log(np.linspace(0.6, 1.6, 11)).tolist()
    for stiffness in np.log([0.4, 0.6, 0.8, 1.0, 1.25, 1.6, 2.5]).tolist()
]
"""Logarithms of factors on modulus and stiffnesses at which searches start."""

FALSE_ALARM = 0.01
"""False-alarm rate of a test of values, form or thickness on correct plates."""

MAX_FIT_ERROR = 0.2
"""Largest RMS error of an acceptable plate, relative to the response."""

MODEL_ERROR = 0.05
"""Error of values relative to their row's RMS: scales and positions of sensors, and model
errors.
"""

MIN_COST_REDUCTION = 20.0
"""Cost reduction that proves another wiring or conjugated phases."""

_GAIN_STD = 0.08  # over frequency, relative
_SOFT = 2.0  # standard deviations
_MAX_OUTLIERS = (
    0.05  # of all values; of a plate 3 % longer than its rig's, a tenth look like outliers
)
_MIN_CONFIDENCE = 0.99  # minimum, for an ERA other than the rig's
_LEAST_MISFIT = 0.02  # below it, sensor errors dominate

SIZE_FACTORS = (0.6, 0.67, 0.75, 0.82, 0.88, 0.94, 1.06, 1.13, 1.21, 1.33, 1.5, 1.67)
_STIFFNESSES = (0.01, 0.03, 0.1, 0.2, 0.35, 0.5, 0.65, 0.8, 1.25, 1.5, 2.0, 3.0, 5.0, 10.0, 30.0)
FITTED_HYPOTHESES = 5  # hypotheses for which the rest of the rig is fitted
REFINED_HYPOTHESES = 2  # best hypotheses whose value is refined
_REFINEMENTS = 7  # values
_CORRELATION = 4.0  # since model errors are correlated over sensors and frequencies

_NOISE = (0.01, 0.05)  # of a row's RMS, minimum and maximum for weights of a fit with form errors
_FIRST_NOISE = 0.02
_LOAD_GRID = Grid(32, 24)  # where loads are sought
_MAX_LOADS = 2
_LIGHT, _FIRM = 0.3, 3.0  # of a fingertip
_CLEAR_LOAD = 40.0  # reduction of half the sum of squares

Load: TypeAlias = PointLoad | FingertipLoad
"""Load that can lie on a plate."""


@dataclass(frozen=True, eq=False)
class Match:
    """Best fit of a plate to values of channels."""

    plate: SensedPlate
    """The plate of the rig before the fit."""
    values: ComplexArray
    """Values (f, s, n) of the channels, NaN where unknown."""
    fit: Fit
    """Fit of the values relative to the level of each channel."""
    beside: FloatArray
    """Logarithm of each channel's level relative to the gain of the ERA that it drives (n,)."""
    model_error: float
    """Model error used to weight the values, relative to the RMS of their row."""

    @property
    def drives(self) -> list[int]:
        """Index of the ERA that each channel drives (n,)."""
        return [*self.fit.measurement.drives]

    @cached_property
    def rig(self) -> Rig:
        """The rig with the fitted values."""
        return self.plate.rig_at(self.fit.x)

    @cached_property
    def z(self) -> FloatArray:
        """Deviation of each fitted value (n,); see `SensedPlate.deviations`."""
        return self.plate.deviations(self.fit.x)

    @cached_property
    def responses(self) -> ComplexArray:
        """Responses (f, s, eras) to the ERAs, without gains."""
        model = self.plate.model
        return model.at(np.where(model.space.of("gain"), 0.0, self.fit.x)).responses

    @cached_property
    def gains(self) -> FloatArray:
        """Magnitude of the gain of each channel (n,), NaN if not used."""
        own = np.array(self.fit.space.indices("gain"))[self.drives]
        used = np.isfinite(self.values).any(axis=(0, 1))
        return np.where(used, np.exp(self.beside + (self.fit.space.std * self.fit.x)[own]), np.nan)

    @cached_property
    def predicted(self) -> ComplexArray:
        """Responses (f, s, n) of the ERAs that the channels drive, with gains; NaN if not used."""
        found = self.fit.measurement.driven(self.fit.plate.responses) * np.exp(self.beside)
        return np.where(np.isfinite(self.gains), found, np.nan)

    @cached_property
    def outliers(self) -> NDArray[np.bool_]:
        """Mask of outliers (f, s, n), which a calibration would leave out.

        Empty if there are too many. Most of a sensor's values are not counted as outliers either:
        they show a wrong plate, wiring or sensor position.
        """
        known = np.isfinite(self.values)
        left, _ = without_outliers(
            self.values, self.fit.measurement.driven(self.fit.plate.responses)
        )
        found = known & ~np.isfinite(left)
        found[:, found.sum(axis=(0, 2)) > known.sum(axis=(0, 2)) / 2] = False
        return found & bool(found.sum() <= _MAX_OUTLIERS * known.sum())

    @cached_property
    def shares(self) -> FloatArray:
        """Residuals relative to the RMS of their row (m,)."""
        kept = np.where(self.outliers, np.nan, self.fit.measurement.values)
        measured = replace(
            self.fit.measurement, values=kept, errors=_errors(kept, self.model_error)
        )
        responses = measured.driven(self.fit.plate.responses)
        left = best_gains(responses, np.zeros((*kept.shape, 0)), measured)[2]
        return self.model_error * np.abs(left)

    @property
    def error(self) -> float:
        """RMS of the residuals relative to the RMS of their row."""
        return rms(self.shares) if len(self.shares) else math.inf

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
        """Upper bound of the fraction of correct plates with a value at least as far off."""
        return float(2 * len(self.z) * ndtr(-self.worst))


def _errors(values: ComplexArray, share: float) -> FloatArray:
    """Return errors of values (f, s, n): a fraction of the RMS of their row."""
    return share * np.broadcast_to(row_rms(values), values.shape)


def match_plate(
    plate: SensedPlate,
    values: ComplexArray,
    *,
    drives: Sequence[int],
    model_error: float = MODEL_ERROR,
    starts: Sequence[tuple[float, float]] = ((0.0, 0.0),),
) -> Match:
    """Fit a rig's plate at sensors to values (f, s, n) of channels.

    drives (n,): index of the ERA that each channel drives; model_error: relative to a row's RMS;
    starts: logarithms of factors on the modulus and on all stiffnesses at which to start.
    """
    model, driven, known = plate.model, list(drives), np.isfinite(values)
    heard = known.any(axis=1)
    used = heard.any(axis=0)
    own = np.array(model.space.indices("gain"))[driven]
    searched = model.space.uncertain & ~model.space.of("gain")
    searched[own[used]] = True
    std, tried = model.space.std[own], []
    for start in starts:
        at = plate.moved(*start)
        predicted = np.where(known, model.at(at).responses[..., driven], np.nan)
        ratio = np.log(np.maximum(row_rms(values) / row_rms(predicted), 1e-6))[:, 0]
        levels = np.nan_to_num(known_median(np.where(heard, ratio, np.nan)))
        at[own[used]] = (levels / std)[used]
        # Two channels can drive one ERA: each has its level relative to the gain of the last one.
        beside = np.where(used, levels - std * at[own], 0.0)
        scaled = values / np.exp(beside)
        measured = Measurement(
            model.sensors,
            model.frequencies,
            scaled,
            _errors(scaled, model_error),
            gain_std=_GAIN_STD,
            drives=tuple(driven),
        )
        found = fit(model, measured, searched=searched, start=at, soft=_SOFT)
        tried.append(Match(plate, values, found, beside, model_error))
    return likeliest(tried)


def likeliest(matches: Sequence[Match]) -> Match:
    """Return the match with the lowest cost; if several are nearly equal, the first."""
    return best_by(matches, lambda each: -each.fit.cost)


def known_median(values: FloatArray) -> FloatArray:
    """Return the median over the first axis of the known values (f, ...), NaN without any."""
    ordered, count = np.sort(values, axis=0), np.isfinite(values).sum(axis=0)
    low = np.take_along_axis(ordered, np.maximum(count - 1, 0)[None] // 2, axis=0)
    high = np.take_along_axis(ordered, count[None] // 2, axis=0)  # NaN without any
    return np.asarray((low[0] + high[0]) / 2)


def modal_assurance(values: ComplexArray, model: ComplexArray) -> FloatArray:
    """Modal assurance criterion |a^H d|² / (|a|² |d|²) of shapes (..., s); NaN for empty ones.

    1 for the same shape with any gain, about 1/s for noise. Values that are not finite are ignored.
    """
    measured = np.isfinite(values)
    values, model = np.where(measured, values, 0), np.where(measured, model, 0)
    inner = np.abs((model.conj() * values).sum(axis=-1)) ** 2
    power = (np.abs(values) ** 2).sum(axis=-1) * (np.abs(model) ** 2).sum(axis=-1)
    return np.where(power > 0, inner / np.where(power > 0, power, 1), np.nan)


@dataclass(frozen=True, eq=False)
class ShapeMatch:
    """MAC of channels and ERAs on the most similar plate."""

    mac: FloatArray
    """MAC (f, n, n) between the channel wired to the first ERA in the rig and the second ERA, NaN
    if not driven."""
    start: tuple[float, float] = (0.0, 0.0)
    """Logarithms of that plate's factors on modulus and stiffnesses."""

    @property
    def starts(self) -> tuple[tuple[float, float], ...]:
        """Logarithms of factors at which to start: 0, and the factors of that plate."""
        return tuple(dict.fromkeys([(0.0, 0.0), self.start]))

    @cached_property
    def medians(self) -> FloatArray:
        """Medians of the MAC over frequency (n, n)."""
        return known_median(self.mac)

    @cached_property
    def nearest(self) -> list[int]:
        """Index of the ERA most similar to each channel; its own if not driven."""
        return [
            best_of(np.nan_to_num(row, nan=-1.0)) if np.isfinite(row).any() else number
            for number, row in enumerate(self.medians)
        ]

    def error(self, eras: Sequence[int] | None = None) -> float:
        """RMS fraction of the responses that the shapes of ERAs (n,) leave unexplained.

        eras: default each channel's own.
        """
        own = range(self.mac.shape[1])
        alike = self.mac[:, own, list(own if eras is None else eras)]
        left = 1 - alike[np.isfinite(alike)]
        return math.sqrt(max(0.0, float(left.mean()))) if len(left) else math.inf

    def confidence(self, channel: int, era: int, other: int) -> float:
        """Confidence 0 to 1 that the channel drives one ERA and not the other.

        From Student's t-test on the difference of their misfits over frequencies.
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
    """Compare values (f, s, n) with the responses (f, s, n) of a single plate."""
    model, values = model.swapaxes(1, 2), values.swapaxes(1, 2)
    return ShapeMatch(modal_assurance(values[:, :, None], model[:, None]), start)


def match_shapes(plate: SensedPlate, values: ComplexArray) -> ShapeMatch:
    """Compare values (f, s, n) with a rig's ERAs on plates with other modulus and stiffnesses."""

    def score(found: ShapeMatch) -> float:
        alike = [found.medians[number, era] for number, era in enumerate(found.nearest)]
        # Values far from the rig's must fit clearly better.
        return float(np.nansum(alike) - 0.05 * sum(map(abs, found.start)) * len(alike))

    tried = [
        match_responses(plate.model.at(plate.moved(*start)).responses, values, start)
        for start in [(0.0, 0.0), *STARTS]
    ]
    return best_by(tried, score)


def best_wiring(plate: SensedPlate, values: ComplexArray, shapes: ShapeMatch) -> Match:
    """Match the best plate and wiring: the rig's unless another is clearly better.

    values (f, s, n); shapes: their match with the plate.
    """
    own = [*range(values.shape[2])]
    nearest = [
        era if era == n or shapes.confidence(n, era, n) >= _MIN_CONFIDENCE else n
        for n, era in enumerate(shapes.nearest)
    ]
    found = [
        match_plate(plate, values, drives=drives, starts=shapes.starts)
        for drives in ([own] if nearest == own else [own, nearest])
    ]
    return best_by(found, lambda each: -each.fit.cost - MIN_COST_REDUCTION * (each.drives != own))


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """Alternative plate: one value of the rig differs, and the rest is fitted."""

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
    """Fraction 0 to 1 of the likelihood among all hypotheses."""

    @property
    def era(self) -> str:
        """Name of the ERA if the value belongs to a single ERA, otherwise ""."""
        return self.key[len("eras.") :].rpartition(".")[0]

    @property
    def explains(self) -> bool:
        """Whether the rest of the rig is within its priors."""
        return self.match.error <= MAX_FIT_ERROR and self.match.chance >= FALSE_ALARM


def _ranges(rig: Rig) -> dict[str, tuple[str, tuple[float, ...]]]:
    """Return units of the rig values that can be wrong, and the factors to try, by key."""
    of_eras = {f"eras.{era.name}.stiffness": ("N/m", _STIFFNESSES) for era in rig.eras}
    return {
        **{f"plate.{name}": ("m", SIZE_FACTORS) for name in ("thickness", "length", "width")},
        "plate.material.E": ("Pa", tuple(size**2 for size in SIZE_FACTORS)),
        "plate.loss_factor": ("", (0.1, 0.3, 3.0, 10.0, 30.0)),
        "eras.stiffness": ("N/m", _STIFFNESSES),
        "eras.bolt_mass": ("kg", (0.01, 0.02, 0.04, 0.08, 0.16)),
        **of_eras,
    }


def _value(rig: Rig, key: str) -> float:
    """Return the value of a key in a rig, the mean for a key of all ERAs."""
    owner, _, name = key.rpartition(".")
    if not key.startswith("eras"):
        return float(rig.plate.material.E if name == "E" else getattr(rig.plate, name))
    eras = [era for era in rig.eras if owner in ("eras", f"eras.{era.name}")]
    return float(np.mean([getattr(era, era.fields[name]) for era in eras]))


def _varied(rig: Rig, key: str, factor: float) -> Rig:
    """Return the rig with another value of a key; for bolts, a fraction of the plate's mass.

    Raises InputError for an impossible value.
    """
    plate, (owner, _, name) = rig.plate, key.rpartition(".")
    if name in ("thickness", "E"):
        return replace(rig, plate=plate.scaled(**{"modulus" if name == "E" else name: factor}))
    if name == "loss_factor":
        return replace(rig, plate=replace(plate, loss_factor=min(plate.loss_factor * factor, 0.9)))
    if name in ("length", "width"):
        # Attachments move in proportion.
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


def _solved(match: Match, key: str, factor: float) -> SensedPlate | None:
    """Return the plate of a match with another value of a key, None if the value is impossible."""
    try:
        other = _varied(match.plate.rig, key, factor)
    except InputError:
        return None
    if key not in ("plate.length", "plate.width"):
        return match.plate.of(other)
    # A sensor that would be off the plate is moved to its edge.
    measured = match.fit.measurement
    points = np.clip(measured.points, 0, [other.plate.length, other.plate.width])
    return sensed_plate(other, measured.moved(points).sensors, measured.frequencies)


def _matched(match: Match, key: str, factor: float) -> Match | None:
    if other := _solved(match, key, factor):
        return match_plate(other, match.values, drives=match.drives, model_error=match.model_error)
    return None


def compared(match: Match) -> list[Hypothesis]:
    """Find other plates that explain the values of a match, most likely first.

    Varies one value at a time. Density is not varied, since it is the inverse of modulus and
    stiffnesses.
    """
    rig, of = match.plate.rig, _ranges(match.plate.rig)
    scores = [
        (_misfit(match.values, other.responses()[..., match.drives]), factor, key)
        for key, (_, factors) in of.items()
        for factor in factors
        if (other := _solved(match, key, factor))
    ]
    best = {key: (score, factor) for score, factor, key in ranked_by(scores, lambda each: each[0])}
    fits = []
    best_first = ranked_by([*best.items()], lambda each: -each[1][0])
    for key, (_, factor) in best_first[:FITTED_HYPOTHESES]:
        if found := _matched(match, key, factor):
            fits.append((key, factor, found))
    fits = ranked_by(fits, lambda each: -each[2].fit.cost)
    for number, (key, factor, found) in enumerate(fits[:REFINED_HYPOTHESES]):
        refined = _refined(of[key][1], factor, found, partial(_matched, match, key))
        fits[number] = (key, factor, refined)
    costs = np.array([found.fit.cost for _, _, found in fits])
    weights = np.exp(-(costs - costs.min()) / _CORRELATION)
    hypotheses = [
        Hypothesis(key, of[key][0], _value(rig, key), _value(found.rig, key), found, float(share))
        for (key, _, found), share in zip(fits, weights / weights.sum(), strict=True)
    ]
    return ranked_by(hypotheses, lambda each: each.share)


def _refined(
    factors: Sequence[float], factor: float, match: Match, matched: Callable[[float], Match | None]
) -> Match:
    """Search for the best factor between the neighbors of a factor in a range."""
    padded = (factors[0] / 1.5, *factors, factors[-1] * 1.5)
    at, known = 1 + factors.index(factor), [match]

    def cost(logarithm: float) -> float:
        tried = matched(math.exp(logarithm))
        if tried is None:
            return match.fit.cost * 1e3
        known.append(tried)
        return tried.fit.cost

    minimize_scalar(
        cost,
        bounds=(math.log(padded[at - 1]), math.log(padded[at + 1])),
        method="bounded",
        options={"maxiter": _REFINEMENTS, "xatol": 3e-3},
    )
    return likeliest(known)


def _misfit(values: ComplexArray, model: ComplexArray) -> float:
    """Difference of shapes and, up to one gain per channel, of magnitudes; 0 if equal."""
    mac = modal_assurance(values.swapaxes(1, 2), model.swapaxes(1, 2))
    known = np.isfinite(values)
    driven = known.any(axis=(0, 1))
    ratio = np.log(row_rms(values) / row_rms(np.where(known, model, np.nan)))[:, 0, driven]
    deviation = np.minimum(np.abs(ratio - np.nanmedian(ratio, axis=0)), 1.0)
    return float(np.nanmean(1 - mac) + 0.5 * np.nanmean(deviation))


def match_with_form(match: Match) -> tuple[Match, list[Load]]:
    """Fit form errors to the values of a match, and find loads on the plate.

    Form errors explain inaccurate cutting and positioning, but not a single mass near an edge.
    """

    def matched(loads: Sequence[Load], noise: float) -> Match:
        rig = match.plate.rig
        rig = replace(rig, masses=(*rig.masses, *loads))  # type: ignore[arg-type]
        sensed = plate_of(rig, match.fit.measurement, has_form=True)
        return match_plate(sensed, match.values, drives=match.drives, model_error=noise)

    noise = float(np.clip(matched((), _FIRST_NOISE).error, *_NOISE))
    best, loads = matched((), noise), list[Load]()
    while len(loads) < _MAX_LOADS and (further := _loads(best)):
        tried = [(each, matched((*loads, each), noise)) for each in further]
        load, found = best_by(tried, lambda each: -each[1].fit.cost)
        if found.fit.cost > best.fit.cost - _CLEAR_LOAD:
            break
        best, loads = found, [*loads, load]
    return best, loads


def linearised(match: Match) -> Fit:
    """Return the fit of a match, linearized with free gains at every frequency."""
    kept = np.where(match.outliers, np.nan, match.values)
    errors = _errors(kept, match.model_error)
    measured = replace(match.fit.measurement, values=kept, errors=errors, gain_std=math.inf)
    model = match.plate.model
    searched = model.space.uncertain & ~model.space.of("gain")
    return fit(model, measured, searched=searched, start=match.fit.x, evaluations=1)


def _loads(match: Match) -> Sequence[Load]:
    """Return a mass and a finger at the positions where each would explain most.

    A finger lighter than a fraction of a fingertip is skipped.
    """
    rig, omega, free = match.plate.rig, match.plate.model.omega, linearised(match)
    points, tip = _LOAD_GRID.centres(rig.plate), rig.fingertip or Fingertip()
    found: list[Load] = []
    for number, mass in free.loads(points, std=rig.plate.mass)[:1]:
        x, y = points[number].tolist()
        found.append(PointLoad(x, y, mass=mass))
    factor = -tip.dynamic_stiffness(omega) / omega**2
    for number, size in free.loads(points, factor=factor)[:1]:
        if size >= _LIGHT:
            x, y = points[number].tolist()
            found.append(FingertipLoad(x, y, tip.multiplied(min(size, _FIRM))))
    return found
