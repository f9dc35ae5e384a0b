"""Find the plate and wiring that explain the measured values of channels best.

    d_fsn ~ m_fn exp(i phi_fn) a_fsn(x) + noise,   m_fn near G_n

d are measured values, a the model's values, G_n the gain of a channel. Magnitudes m vary about G_n
with frequency, as in real actuators. Phases phi are free, because a measurement can lack them. Both
follow from x and G, so that only x and G are searched (`model.estimate.fit`). Priors hold x near
the rig's values: a large difference is evidence against the rig.

The ERA that a channel drives is identified by the modal assurance criterion (MAC) of shapes: 1 for
the same shape with any gain and phase, about one over the number of sensors for noise.

If the rig's plate does not fit, each `Hypothesis` varies one value over a range, and the other
values of the rig are fitted within their priors. If it fits, loads are searched at the positions
with the largest effect.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar
from scipy.special import ndtr, stdtr

from model.arrays import ComplexArray, FloatArray, best_by, best_of, ranked_by, rms
from model.errors import InputError
from model.estimate.fit import Fit, fit
from model.estimate.gains import best_gains, row_rms
from model.estimate.measurement import Measurement
from model.estimate.noise import without_outliers
from model.estimate.sensed_plate import SensedPlate, plate_of, sensed_plate
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
_SOFT = 2.0  # standard errors
# Of all values. On a plate 3 % longer than in its rig, a tenth of the values look like outliers.
_MAX_OUTLIERS = 0.05
_MIN_CONFIDENCE = 0.99  # minimum, for an ERA other than the rig's
_LEAST_MISFIT = 0.02  # below it, sensor errors dominate
_MIN_RATIO = 1e-6  # of measured to predicted values
_MIN_COMPARED = 3  # frequencies, for the confidence in an ERA
_START_PENALTY = 0.05  # of MAC per unit of a start's logarithms

SIZE_FACTORS = (0.6, 0.67, 0.75, 0.82, 0.88, 0.94, 1.06, 1.13, 1.21, 1.33, 1.5, 1.67)
_STIFFNESSES = (0.01, 0.03, 0.1, 0.2, 0.35, 0.5, 0.65, 0.8, 1.25, 1.5, 2.0, 3.0, 5.0, 10.0, 30.0)
_LOSSES = (0.1, 0.3, 3.0, 10.0, 30.0)
_BOLTS = (0.01, 0.02, 0.04, 0.08, 0.16)  # of the plate's mass
_MAX_LOSS_FACTOR = 0.9
_BEYOND_RANGE = 1.5  # factor on the ends of a range
# Natural frequencies of another plate, relative to those of the solved plate, from which on its
# solution is scaled. The modes it has kept then reach well beyond the tones.
_MIN_SCALED_FREQUENCY = 0.85
FITTED_HYPOTHESES = 5  # hypotheses for which the rest of the rig is fitted
REFINED_HYPOTHESES = 2  # best hypotheses whose value is refined
_REFINEMENTS = 7  # values
_IMPOSSIBLE_COST = 1e3  # of an impossible value, relative to the cost of the match
_CORRELATION = 4.0  # since model errors are correlated over sensors and frequencies

_NOISE = (0.01, 0.05)  # of a row's RMS, minimum and maximum for weights of a fit with form errors
_FIRST_NOISE = 0.02
_LOAD_GRID = Grid(32, 24)  # positions of loads
_MAX_LOADS = 2
_LIGHT, _FIRM = 0.3, 3.0  # of a fingertip
_CLEAR_LOAD = 40.0  # reduction of half the sum of squares

Load: TypeAlias = PointLoad | FingertipLoad
"""Load that can lie on a plate."""


@dataclass(frozen=True, eq=False)
class Match:
    """Best fit of a plate to values of channels."""

    values: ComplexArray
    """Values (f, s, n) of the channels, NaN where unknown."""
    fit: Fit[SensedPlate]
    """Fit of the values relative to the level of each channel."""
    levels: FloatArray
    """Logarithm of each channel's level relative to the gain of the ERA that it drives (n,)."""
    model_error: float
    """Model error used to weight the values, relative to the RMS of their row."""

    @property
    def plate(self) -> SensedPlate:
        """The plate of the rig before the fit."""
        return self.fit.model

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
        """Relative difference of each fitted value (n,); see `SensedPlate.deviations`."""
        return self.plate.deviations(self.fit.x)

    @cached_property
    def responses(self) -> ComplexArray:
        """Responses (f, s, eras) to the ERAs, without gains."""
        is_gain = self.fit.space.of("gain")
        return self.plate.responses(np.where(is_gain, 0.0, self.fit.x))

    @cached_property
    def gains(self) -> FloatArray:
        """Magnitude of the gain of each channel (n,), NaN if not used."""
        log_gains = self.fit.space.values(self.fit.x, "gain")[self.drives]
        used = np.isfinite(self.values).any(axis=(0, 1))
        return np.where(used, np.exp(self.levels + log_gains), np.nan)

    @cached_property
    def _fitted_responses(self) -> ComplexArray:
        """Responses (f, s, n) of the ERAs that the channels drive, relative to `levels`."""
        return self.fit.measurement.driven(self.fit.fitted_plate.responses)

    @cached_property
    def predicted(self) -> ComplexArray:
        """Responses (f, s, n) of the ERAs that the channels drive, with gains; NaN if not used."""
        predicted = self._fitted_responses * np.exp(self.levels)
        return np.where(np.isfinite(self.gains), predicted, np.nan)

    @cached_property
    def outliers(self) -> NDArray[np.bool_]:
        """Mask of outliers (f, s, n), which a calibration would leave out.

        Empty if there are too many. Most of a sensor's values are not counted as outliers either:
        they show a wrong plate, wiring or sensor position.
        """
        measured = np.isfinite(self.values)
        std, _ = without_outliers(self.values, self._fitted_responses)
        outliers = measured & ~np.isfinite(std)
        is_bad_sensor = outliers.sum(axis=(0, 2)) > measured.sum(axis=(0, 2)) / 2
        outliers[:, is_bad_sensor] = False
        return outliers & bool(outliers.sum() <= _MAX_OUTLIERS * measured.sum())

    @cached_property
    def residuals(self) -> FloatArray:
        """Magnitudes of the residuals relative to the RMS of their row (m,)."""
        measurement = self.fit.measurement
        values = np.where(self.outliers, np.nan, measurement.values)
        errors = _errors(values, self.model_error)
        measurement = replace(measurement, values=values, errors=errors)
        no_slopes = np.zeros((*values.shape, 0))
        gain_fit = best_gains(self._fitted_responses, no_slopes, measurement)
        return self.model_error * np.abs(gain_fit.residuals)

    @property
    def error(self) -> float:
        """RMS of the residuals relative to the RMS of their row."""
        return rms(self.residuals) if len(self.residuals) else math.inf

    @property
    def median_error(self) -> float:
        """Median of the same."""
        return float(np.median(self.residuals)) if len(self.residuals) else math.inf

    @property
    def worst(self) -> float:
        """The largest of |z|."""
        return float(np.abs(self.z).max())

    @property
    def chance(self) -> float:
        """Upper bound of the fraction of correct plates with a value at least as far off."""
        return float(2 * len(self.z) * ndtr(-self.worst))


def _errors(values: ComplexArray, relative: float) -> FloatArray:
    """Return errors of values (f, s, n): a fraction of the RMS of their row."""
    return relative * np.broadcast_to(row_rms(values), values.shape)


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
    matches = []
    for modulus, stiffness in starts:
        start = plate.start(modulus, stiffness)
        matches.append(_match_from(plate, start, values, list(drives), model_error))
    return likeliest(matches)


def _match_from(
    plate: SensedPlate,
    start: FloatArray,
    values: ComplexArray,
    drives: list[int],
    model_error: float,
) -> Match:
    """Fit a plate from a start (p,); see `match_plate`."""
    space = plate.space
    measured = np.isfinite(values)
    has_values = measured.any(axis=1)
    used = has_values.any(axis=0)
    gains = np.array(space.indices("gain"))[drives]
    searched = space.uncertain & ~space.of("gain")
    searched[gains[used]] = True
    predicted = np.where(measured, plate.responses(start)[..., drives], np.nan)
    ratio = np.maximum(row_rms(values) / row_rms(predicted), _MIN_RATIO)
    log_ratio = np.where(has_values, np.log(ratio)[:, 0], np.nan)
    levels = np.nan_to_num(known_median(log_ratio))
    std = space.std[gains]
    start[gains[used]] = (levels / std)[used]
    # Two channels can drive one ERA: each has its level relative to the gain of the last one.
    levels = np.where(used, levels - std * start[gains], 0.0)
    scaled = values / np.exp(levels)
    measurement = Measurement(
        plate.sensors,
        plate.frequencies,
        scaled,
        _errors(scaled, model_error),
        gain_std=_GAIN_STD,
        drives=tuple(drives),
    )
    result = fit(plate, measurement, searched=searched, start=start, soft=_SOFT)
    return Match(values=values, fit=result, levels=levels, model_error=model_error)


def likeliest(matches: Sequence[Match]) -> Match:
    """Return the match with the lowest cost; if several are nearly equal, the first."""
    return best_by(matches, lambda match: -match.fit.cost)


def known_median(values: FloatArray) -> FloatArray:
    """Return the median over the first axis of the known values (f, ...), NaN without any."""
    ordered = np.sort(values, axis=0)
    count = np.isfinite(values).sum(axis=0)[None]
    lower = np.take_along_axis(ordered, np.maximum(count - 1, 0) // 2, axis=0)
    upper = np.take_along_axis(ordered, count // 2, axis=0)  # NaN without any
    return np.asarray((lower[0] + upper[0]) / 2)


def modal_assurance(values: ComplexArray, model: ComplexArray) -> FloatArray:
    """Modal assurance criterion |a^H d|² / (|a|² |d|²) of shapes (..., s); NaN for empty ones.

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
        nearest = list(range(len(self.medians)))
        for channel, mac in enumerate(self.medians):
            if np.isfinite(mac).any():
                nearest[channel] = best_of(np.nan_to_num(mac, nan=-1.0))
        return nearest

    def error(self, eras: Sequence[int] | None = None) -> float:
        """RMS fraction of the responses that the shapes of ERAs (n,) leave unexplained.

        eras: default each channel's own.
        """
        channels = range(self.mac.shape[1])
        mac = self.mac[:, channels, list(channels if eras is None else eras)]
        unexplained = 1 - mac[np.isfinite(mac)]
        if not len(unexplained):
            return math.inf
        return math.sqrt(max(0.0, float(unexplained.mean())))

    def confidence(self, channel: int, era: int, rival: int) -> float:
        """Confidence 0 to 1 that the channel drives one ERA and not a rival.

        From Student's t-test on the difference of their misfits over frequencies.
        """
        misfit = np.log(np.maximum(1 - self.mac[:, channel], _LEAST_MISFIT))
        gain = misfit[:, rival] - misfit[:, era]
        gain = gain[np.isfinite(gain)]
        if len(gain) < _MIN_COMPARED or np.ptp(gain) == 0:
            return 0.5
        t = gain.mean() * np.sqrt(len(gain)) / gain.std(ddof=1)
        return float(stdtr(len(gain) - 1, t))


def match_responses(
    model: ComplexArray, values: ComplexArray, start: tuple[float, float] = (0.0, 0.0)
) -> ShapeMatch:
    """Compare values (f, s, n) with the responses (f, s, n) of a single plate."""
    shapes = model.swapaxes(1, 2)[:, None]
    return ShapeMatch(modal_assurance(values.swapaxes(1, 2)[:, :, None], shapes), start)


def match_shapes(plate: SensedPlate, values: ComplexArray) -> ShapeMatch:
    """Compare values (f, s, n) with a rig's ERAs on plates with other modulus and stiffnesses."""
    matches = []
    for start in [(0.0, 0.0), *STARTS]:
        responses = plate.responses(plate.start(*start))
        matches.append(match_responses(responses, values, start))
    return best_by(matches, _shape_score)


def _shape_score(shapes: ShapeMatch) -> float:
    """Sum of the MAC of all channels; values far from the rig's must fit clearly better."""
    mac = [shapes.medians[channel, era] for channel, era in enumerate(shapes.nearest)]
    return float(np.nansum(mac) - _START_PENALTY * sum(map(abs, shapes.start)) * len(mac))


def best_wiring(plate: SensedPlate, values: ComplexArray, shapes: ShapeMatch) -> Match:
    """Match the best plate and wiring: the rig's unless another is clearly better.

    values (f, s, n); shapes: their match with the plate.
    """
    rig_wiring = list(range(values.shape[2]))
    nearest = rig_wiring.copy()
    for channel, era in enumerate(shapes.nearest):
        if era != channel and shapes.confidence(channel, era, channel) >= _MIN_CONFIDENCE:
            nearest[channel] = era
    match = match_plate(plate, values, drives=rig_wiring, starts=shapes.starts)
    if nearest == rig_wiring:
        return match
    rewired = match_plate(plate, values, drives=nearest, starts=shapes.starts)
    scores = [-match.fit.cost, -rewired.fit.cost - MIN_COST_REDUCTION]
    return (match, rewired)[best_of(scores)]


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
        if not self.key.startswith("eras."):
            return ""
        return self.key.removeprefix("eras.").rpartition(".")[0]

    @property
    def explains(self) -> bool:
        """Whether the rest of the rig is within its priors."""
        return self.match.error <= MAX_FIT_ERROR and self.match.chance >= FALSE_ALARM


@dataclass(frozen=True)
class _Variation:
    """A value of a rig that can be wrong."""

    key: str
    """Key in the rig file; `eras.NAME` for the values of all ERAs."""
    unit: str
    factors: tuple[float, ...]
    """Factors on the value to compare; for bolts, fractions of the plate's mass."""

    @property
    def name(self) -> str:
        """Last part of the key."""
        return self.key.rpartition(".")[2]

    @property
    def is_size(self) -> bool:
        """Whether it is a side of the plate."""
        return self.name in ("length", "width")

    def concerns(self, era: str) -> bool:
        """Whether it is a value of an ERA."""
        return self.key.rpartition(".")[0] in ("eras", f"eras.{era}")

    def value(self, rig: Rig) -> float:
        """Return the value in a rig, the mean over all ERAs."""
        if self.name == "E":
            return rig.plate.material.E
        if self.key.startswith("plate"):
            return float(getattr(rig.plate, self.name))
        eras = [era for era in rig.eras if self.concerns(era.name)]
        return float(np.mean([getattr(era, era.fields[self.name]) for era in eras]))

    def applied(self, rig: Rig, factor: float) -> Rig:
        """Return the rig with another value; raises InputError for an impossible value."""
        plate = rig.plate
        if self.is_size:
            return _resized(rig, **{self.name: factor})
        if self.name == "thickness":
            return replace(rig, plate=plate.scaled(thickness=factor))
        if self.name == "E":
            return replace(rig, plate=plate.scaled(modulus=factor))
        if self.name == "loss_factor":
            loss_factor = min(plate.loss_factor * factor, _MAX_LOSS_FACTOR)
            return replace(rig, plate=replace(plate, loss_factor=loss_factor))
        eras: list[Actuator] = []
        for era in rig.eras:
            if self.concerns(era.name):
                era = self._varied(era, factor, plate.mass)
            eras.append(era)
        return replace(rig, eras=tuple(eras))

    def _varied(self, era: Actuator, factor: float, plate_mass: float) -> Actuator:
        if self.name == "bolt_mass":
            bolt = era.fields["bolt_mass"]
            return replace(era, **{bolt: getattr(era, bolt) + factor * plate_mass})
        if self.key == "eras.stiffness":
            return era.varied(stiffness=factor)
        return era.loosened(factor)


def _resized(rig: Rig, *, length: float = 1.0, width: float = 1.0) -> Rig:
    """Return the rig with its sides multiplied by factors; attachments move in proportion."""
    plate = rig.plate
    plate = replace(plate, length=plate.length * length, width=plate.width * width)
    return replace(
        rig,
        plate=plate,
        eras=tuple(replace(era, x=era.x * length, y=era.y * width) for era in rig.eras),
        masses=tuple(replace(mass, x=mass.x * length, y=mass.y * width) for mass in rig.masses),
        mesh=stretched(rig.mesh, plate),
    )


def _variations(rig: Rig) -> list[_Variation]:
    """Return the values of a rig that can be wrong.

    Density is not varied, since it is the inverse of modulus and stiffnesses.
    """
    variations = []
    for name in ("thickness", "length", "width"):
        variations.append(_Variation(f"plate.{name}", "m", SIZE_FACTORS))
    moduli = tuple(size**2 for size in SIZE_FACTORS)
    variations += [
        _Variation("plate.material.E", "Pa", moduli),
        _Variation("plate.loss_factor", "", _LOSSES),
        _Variation("eras.stiffness", "N/m", _STIFFNESSES),
        _Variation("eras.bolt_mass", "kg", _BOLTS),
    ]
    for era in rig.eras:
        variations.append(_Variation(f"eras.{era.name}.stiffness", "N/m", _STIFFNESSES))
    return variations


def _solved(match: Match, variation: _Variation, factor: float) -> SensedPlate | None:
    """Return the plate of a match with another value, None if the value is impossible.

    The free plate is solved again for another size, and for a plate too soft for the kept modes.
    """
    try:
        rig = variation.applied(match.plate.rig, factor)
    except InputError:
        return None
    solved_frequency = match.plate.free.plate.lowest_bending_frequency
    is_soft = rig.plate.lowest_bending_frequency < _MIN_SCALED_FREQUENCY * solved_frequency
    if not variation.is_size and not is_soft:
        return match.plate.with_rig(rig)
    measurement = match.fit.measurement
    highest = float(measurement.frequencies.max())
    if highest > rig.mesh.highest_frequency(rig.plate):
        rig = replace(rig, mesh=rig.mesh.resolving(rig.plate, highest))
    # A sensor that would be off the plate is moved to its edge.
    points = np.clip(measurement.points, 0, [rig.plate.length, rig.plate.width])
    return sensed_plate(rig, measurement.moved(points).sensors, measurement.frequencies)


def _rematched(match: Match, variation: _Variation, factor: float) -> Match | None:
    """Match the plate with another value, None if the value is impossible."""
    plate = _solved(match, variation, factor)
    if plate is None:
        return None
    return match_plate(plate, match.values, drives=match.drives, model_error=match.model_error)


@dataclass(frozen=True, eq=False)
class _Candidate:
    """A variation with its best factor among those compared."""

    variation: _Variation
    factor: float
    misfit: float
    """Before the rest of the rig is fitted."""


def compared(match: Match) -> list[Hypothesis]:
    """Find other plates that explain the values of a match, most likely first.

    Varies one value at a time.
    """
    rig = match.plate.rig
    fits = []
    for candidate in _candidates(match)[:FITTED_HYPOTHESES]:
        rematched = _rematched(match, candidate.variation, candidate.factor)
        if rematched:
            fits.append((candidate, rematched))
    fits = ranked_by(fits, lambda fit: -fit[1].fit.cost)
    matches = []
    for number, (candidate, rematched) in enumerate(fits):
        if number < REFINED_HYPOTHESES:
            rematched = _refined(match, candidate, rematched)
        matches.append(rematched)
    costs = np.array([rematched.fit.cost for rematched in matches])
    likelihoods = np.exp(-(costs - costs.min()) / _CORRELATION)
    shares = likelihoods / likelihoods.sum()
    hypotheses = []
    for (candidate, _), rematched, share in zip(fits, matches, shares.tolist(), strict=True):
        variation = candidate.variation
        hypotheses.append(
            Hypothesis(
                key=variation.key,
                unit=variation.unit,
                expected=variation.value(rig),
                value=variation.value(rematched.rig),
                match=rematched,
                share=share,
            )
        )
    return ranked_by(hypotheses, lambda hypothesis: hypothesis.share)


def _candidates(match: Match) -> list[_Candidate]:
    """Return all variations with their best factors, the best variation first."""
    candidates = []
    for variation in _variations(match.plate.rig):
        for factor in variation.factors:
            plate = _solved(match, variation, factor)
            if plate:
                misfit = _misfit(match.values, plate.responses()[..., match.drives])
                candidates.append(_Candidate(variation, factor, misfit))
    worst_first = ranked_by(candidates, lambda candidate: candidate.misfit)
    best = {candidate.variation.key: candidate for candidate in worst_first}
    return ranked_by([*best.values()], lambda candidate: -candidate.misfit)


def _refined(match: Match, candidate: _Candidate, rematched: Match) -> Match:
    """Search for the best factor between the neighbors of a candidate's factor.

    rematched: the match with the candidate's factor.
    """
    factors = candidate.variation.factors
    number = factors.index(candidate.factor)
    padded = (factors[0] / _BEYOND_RANGE, *factors, factors[-1] * _BEYOND_RANGE)
    matches = [rematched]

    def cost(logarithm: float) -> float:
        varied = _rematched(match, candidate.variation, math.exp(logarithm))
        if varied is None:
            return rematched.fit.cost * _IMPOSSIBLE_COST
        matches.append(varied)
        return varied.fit.cost

    minimize_scalar(
        cost,
        bounds=(math.log(padded[number]), math.log(padded[number + 2])),
        method="bounded",
        options={"maxiter": _REFINEMENTS, "xatol": 3e-3},
    )
    return likeliest(matches)


def _misfit(values: ComplexArray, model: ComplexArray) -> float:
    """Difference of shapes and, up to one gain per channel, of magnitudes; 0 if equal."""
    mac = modal_assurance(values.swapaxes(1, 2), model.swapaxes(1, 2))
    measured = np.isfinite(values)
    driven = measured.any(axis=(0, 1))
    ratio = row_rms(values) / row_rms(np.where(measured, model, np.nan))
    log_ratio = np.log(ratio)[:, 0, driven]
    difference = np.minimum(np.abs(log_ratio - np.nanmedian(log_ratio, axis=0)), 1.0)
    return float(np.nanmean(1 - mac) + 0.5 * np.nanmean(difference))


def match_with_form(match: Match) -> tuple[Match, list[Load]]:
    """Fit form errors to the values of a match, and find loads on the plate.

    Form errors explain inaccurate cutting and positioning, but not a single mass near an edge.
    """
    first = _match_loads(match, [], _FIRST_NOISE)
    noise = float(np.clip(first.error, *_NOISE))
    best = _match_loads(match, [], noise)
    loads: list[Load] = []
    while len(loads) < _MAX_LOADS:
        further = [(load, _match_loads(match, [*loads, load], noise)) for load in _loads(best)]
        if not further:
            break
        load, loaded = best_by(further, lambda pair: -pair[1].fit.cost)
        if loaded.fit.cost > best.fit.cost - _CLEAR_LOAD:
            break
        best = loaded
        loads.append(load)
    return best, loads


def _match_loads(match: Match, loads: Sequence[Load], noise: float) -> Match:
    """Match a plate with form errors and loads; noise: relative to a row's RMS."""
    rig = match.plate.rig
    rig = replace(rig, masses=(*rig.masses, *loads))  # type: ignore[arg-type]
    plate = plate_of(rig, match.fit.measurement, has_form=True)
    return match_plate(plate, match.values, drives=match.drives, model_error=noise)


def linearized(match: Match) -> Fit[SensedPlate]:
    """Return the fit of a match, linearized with free gains at every frequency."""
    values = np.where(match.outliers, np.nan, match.values)
    errors = _errors(values, match.model_error)
    measurement = replace(match.fit.measurement, values=values, errors=errors, gain_std=math.inf)
    space = match.plate.space
    searched = space.uncertain & ~space.of("gain")
    return fit(match.plate, measurement, searched=searched, start=match.fit.x, evaluations=1)


def _loads(match: Match) -> Sequence[Load]:
    """Return a mass and a finger at the positions where each would explain most.

    A finger lighter than a fraction of a fingertip is skipped.
    """
    rig = match.plate.rig
    free = linearized(match)
    points = _LOAD_GRID.centers(rig.plate)
    loads: list[Load] = []
    for number, mass in free.loads(points, std=rig.plate.mass)[:1]:
        x, y = points[number].tolist()
        loads.append(PointLoad(x, y, mass=mass))
    tip = rig.fingertip or Fingertip()
    omega = match.plate.omega
    factor = -tip.dynamic_stiffness(omega) / omega**2
    for number, size in free.loads(points, factor=factor)[:1]:
        if size >= _LIGHT:
            x, y = points[number].tolist()
            loads.append(FingertipLoad(x, y, tip.multiplied(min(size, _FIRM))))
    return loads
