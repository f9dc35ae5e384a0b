"""Causes of a mismatch between a rig and a measurement, each with its own test.

A single value of the rig (`explain`) is varied over a range, and for the best ones the rest of the
rig is fitted within its priors. Not tried: two values at once, plates that are not rectangles,
further supports, and density, which cannot be distinguished from the others.

Beyond tolerances (`match_with_form`): the plate is matched once more with form errors, each held by
its tolerance (`KINDS` in `model.estimate.space`). They explain what builders and rulers
do, but not a mass in one place near an edge. Loads are therefore sought where each would explain
most, and named if they are beyond a tolerance. Of the rest, each kind of form error is judged by
its sum of squares at an equal share of the false alarms. A plate that is thinner at one end moves
more there, so that scales of sensors rise along it: that is its taper.

The wrong side: sensors at each other's places or noted from another side, and a grain along the
other side, are other plates, for which no fit of values makes up. Both sides are fitted as coarsely
as wiring is first looked at (`model.estimate.plate_match.match_shapes`): shapes of boards as
bought leave a quarter of the response unexplained with the right side, half to nine tenths with the
other.

Loose glue (`behind_glue`): what comes through a spring z between coil and plate is

    g_f ~ G |z / (z + D(w_f))|

with the gains g_f of a channel and the dynamic stiffness D of its exciter, which falls above the
resonance of the magnet: the gain rises with frequency. What all channels have in common is the
amplifier's.

Channels are dead, and sensors unusable, by the size of their responses.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import compress

import numpy as np
from numpy.typing import NDArray
from scipy import linalg
from scipy.optimize import linear_sum_assignment, minimize_scalar
from scipy.special import chdtrc

from model.arrays import ComplexArray, FloatArray, best_by, ranked_by
from model.errors import InputError
from model.estimate.calibration_fit import (
    Parameter,
    SensedPlate,
    modal_assurance,
    plate_of,
    project_gains,
    projection_slopes,
    responses_of,
    row_rms,
    sensed_plate,
)
from model.estimate.forward import by_mass_at
from model.estimate.identify import solved_for
from model.estimate.least_squares import Linearization
from model.estimate.measurement import Responses, check_enough_sensors, silent_sensors
from model.estimate.plate_match import (
    FALSE_ALARM,
    MAX_FIT_ERROR,
    Match,
    ShapeMatch,
    match_plate,
    match_shapes,
)
from model.estimate.space import VALUE_UNITS
from model.finger import Grid
from model.quantities import percent
from model.rig.rig import Rig
from model.spectral.modes import stretched
from model.structure.attachments import Fingertip, FingertipLoad, PointLoad
from model.structure.exciter import Actuator, Exciter

_SIZES = (0.6, 0.67, 0.75, 0.82, 0.88, 0.94, 1.06, 1.13, 1.21, 1.33, 1.5, 1.67)
_STIFFNESSES = (0.01, 0.03, 0.1, 0.2, 0.35, 0.5, 0.65, 0.8, 1.25, 1.5, 2.0, 3.0, 5.0, 10.0, 30.0)
_LOSSES = (0.1, 0.3, 3.0, 10.0, 30.0)
_MASSES = (0.01, 0.02, 0.04, 0.08, 0.16)  # of the plate's mass, at every ERA
_FITTED_CAUSES = 5  # causes for which the rest of the rig is fitted
_REFINED_CAUSES = 2  # of these, whose value is refined
_REFINEMENTS = 7  # values
_CORRELATION = 4.0  # errors of a model are correlated over sensors and frequencies

MAX_FORM_ERROR = 0.05
"""Largest unexplained share of the responses of a plate that form errors explain."""

_NOISE = (0.01, 0.05)  # of a row's rms: least and largest that a fit is weighted by
_FIRST_NOISE = 0.02
_LOAD_GRID = Grid(32, 24)  # where loads are sought
_MAX_LOADS = 2
_HEAVY = 0.02  # of the plate's mass, all masses together: twice the tolerance of foreign mass
_LIGHT, _FIRM = 0.3, 3.0  # of a fingertip
_MIN_SHOWN = 1e-6  # of a variance
_CLEAR_LOAD = 40.0  # reduction of half the sum of squares

_THICKNESS = "thickness"
_WORDS = {
    "place": "places of ERAs",
    "mode_shifts": "natural frequencies",
    "sensor_scale": "scales of sensors",
    "sensor_place": "places of sensors",
    "foreign_mass": "distribution of mass",
    "side": "length and width",
    "poisson": "Poisson's ratio",
}

_OWN_PLACE, _OTHER_PLACE = 0.8, 0.9  # coherence of an exchanged sensor, at most and at least
_CLEARLY = 0.6  # of the error as written
_MAX_COARSE_ERROR = 0.45  # of a coarse fit of the right board that has a fault
_X, _Y, _FREQUENCY = "x", "y", "frequency"

_GLUES = np.geomspace(100.0, 1e5, 61)  # N/m
_RISES = 0.2  # of the logarithm of a gain over the frequencies
_EXPLAINS = 0.6  # of the median deviation without glue
_MIN_CHANNELS = 3  # of which a median shows what is the amplifier's

_DEAD = 0.03  # of the response that the rig predicts
_FAINT = 0.3  # of it: dead if its shape is not that of an ERA either
_NO_SHAPE = 0.6  # MAC
_SENSOR_SCALE = (0.7, 1.4)
_MUTE = 0.1  # of the others' scale
_UPSIDE_DOWN = -0.5


@dataclass(frozen=True)
class Cause:
    """A value of the rig that may differ: of the plate, of one ERA or of all."""

    key: str
    """Key in the rig file."""
    what: str
    """Kind of value, as a key of `VALUE_UNITS`."""
    factors: tuple[float, ...]
    """Factors by which it is tried; of bolts shares of the plate's mass, which are added."""
    era: str = ""
    """Name of the ERA, "" for all or for the plate."""

    @property
    def unit(self) -> str:
        """Unit of its value."""
        return VALUE_UNITS[self.what]

    @property
    def is_geometry(self) -> bool:
        """Whether the plate must be solved again."""
        return self.what in ("length", "width")

    def value(self, rig: Rig) -> float:
        """The value in a rig [unit], of all ERAs their mean."""
        names = [era.name for era in rig.eras if self._is_of(era)]
        names = [""] if self.key.startswith("plate.") else names
        return float(np.mean([Parameter(self.what, name).of(rig) for name in names]))

    def scaled(self, rig: Rig, factor: float) -> Rig:
        """The rig with another value; raises InputError for one that it cannot have."""
        plate, what = rig.plate, self.what
        if what in ("thickness", "modulus"):
            return replace(rig, plate=plate.scaled(**{what: factor}))
        if what == "loss_factor":
            return replace(
                rig, plate=replace(plate, loss_factor=min(plate.loss_factor * factor, 0.9))
            )
        if self.is_geometry:
            return _stretched(rig, *((factor, 1.0) if what == "length" else (1.0, factor)))
        return replace(
            rig,
            eras=tuple(
                self._changed(era, factor, plate.mass) if self._is_of(era) else era
                for era in rig.eras
            ),
        )

    def _is_of(self, era: Actuator) -> bool:
        return self.era in ("", era.name)

    def _changed(self, era: Actuator, factor: float, plate_mass: float) -> Actuator:
        if self.what == "bolt_mass":
            field = era.fields[self.what]
            return replace(era, **{field: getattr(era, field) + factor * plate_mass})
        return era.loosened(factor) if self.era else era.varied(stiffness=factor)


@dataclass(frozen=True, eq=False)
class Explanation:
    """A cause with its best value."""

    cause: Cause
    value: float
    """Best value."""
    expected: float
    """Value in the rig."""
    match: Match
    """The plate with the best value."""
    share: float
    """Share 0..1 of the likelihood among the explanations."""


def causes_of(rig: Rig) -> list[Cause]:
    """Causes that are tried."""
    moduli = tuple(size**2 for size in _SIZES)
    return [
        Cause("plate.thickness", "thickness", _SIZES),
        Cause("plate.length", "length", _SIZES),
        Cause("plate.width", "width", _SIZES),
        Cause("plate.material.E", "modulus", moduli),
        Cause("plate.loss_factor", "loss_factor", _LOSSES),
        Cause("eras.stiffness", "stiffness", _STIFFNESSES),
        Cause("eras.bolt_mass", "bolt_mass", _MASSES),
        *(
            Cause(f"eras.{era.name}.stiffness", "stiffness", _STIFFNESSES, era.name)
            for era in rig.eras
        ),
    ]


def explain(
    plate: SensedPlate,
    points: FloatArray,
    frequencies: FloatArray,
    values: ComplexArray,
    *,
    drives: Sequence[int],
    model_error: float,
) -> list[Explanation]:
    """Find what explains values (f, e, s) best, most likely first; see `match_plate`."""

    rig = plate.rig

    def solved(cause: Cause, factor: float) -> SensedPlate | None:
        try:
            other = cause.scaled(rig, factor)
        except InputError:
            return None
        if not cause.is_geometry:
            return plate.of(other)
        # A sensor that would be off the plate counts as at its edge.
        on_plate = np.clip(points, 0, [other.plate.length, other.plate.width])
        return sensed_plate(other, on_plate, frequencies, masses=plate.masses)

    def matched(cause: Cause, factor: float) -> Match | None:
        found = solved(cause, factor)
        if found is None:
            return None
        return match_plate(found, values, drives=drives, model_error=model_error)

    scores = []
    for cause in causes_of(rig):
        tried = []
        for factor in cause.factors:
            if found := solved(cause, factor):
                model = found.responses()[:, list(drives)]
                tried.append((_misfit(values, model), factor))
        if tried:
            scores.append((*best_by(tried, lambda each: -each[0]), cause))
    fits = []
    for _, factor, cause in ranked_by(scores, lambda each: -each[0])[:_FITTED_CAUSES]:
        match = matched(cause, factor)
        if match is not None:
            fits.append((cause, factor, match))
    fits = ranked_by(fits, lambda each: -each[2].cost)
    fits[:_REFINED_CAUSES] = [
        (cause, *_refined(cause, factor, match, matched))
        for cause, factor, match in fits[:_REFINED_CAUSES]
    ]
    costs = np.array([match.cost for _, _, match in fits])
    weights = np.exp(-(costs - costs.min()) / _CORRELATION)
    explained = [
        Explanation(
            cause,
            cause.value(match.rig),
            cause.value(rig),
            match,
            float(weight),
        )
        for (cause, _, match), weight in zip(fits, weights / weights.sum(), strict=True)
    ]
    return ranked_by(explained, lambda each: each.share)


def _refined(
    cause: Cause,
    factor: float,
    match: Match,
    matched: Callable[[Cause, float], Match | None],
) -> tuple[float, Match]:
    """Search for the best factor between the neighbours of one in the cause's range."""
    at = cause.factors.index(factor)
    low = cause.factors[max(at - 1, 0)] if at else factor / 1.5
    high = cause.factors[at + 1] if at + 1 < len(cause.factors) else factor * 1.5
    known = {factor: match}

    def cost(logarithm: float) -> float:
        tried = matched(cause, math.exp(logarithm))
        if tried is None:
            return match.cost * 1e3
        known[math.exp(logarithm)] = tried
        return tried.cost

    minimize_scalar(
        cost,
        bounds=(math.log(low), math.log(high)),
        method="bounded",
        options={"maxiter": _REFINEMENTS, "xatol": 3e-3},
    )
    return best_by([*known.items()], lambda each: -each[1].cost)


def _misfit(values: ComplexArray, model: ComplexArray) -> float:
    """Difference of shapes and, up to a gain of each channel, of magnitudes; 0 if equal."""
    mac = modal_assurance(values, model)
    measured = np.isfinite(values)
    norms = (np.linalg.norm(np.where(measured, each, 0), axis=2) for each in (values, model))
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.log(np.divide(*norms))
    ratio = ratio[:, measured.any(axis=(0, 2))]
    deviation = np.minimum(np.abs(ratio - np.nanmedian(ratio, axis=0)), 1.0)
    return float(np.nanmean(1 - mac) + 0.5 * np.nanmean(deviation))


def _stretched(rig: Rig, along_x: float, along_y: float) -> Rig:
    """Plate of another size with everything attached in proportion."""
    plate = replace(rig.plate, length=rig.plate.length * along_x, width=rig.plate.width * along_y)
    eras = tuple(replace(era, x=era.x * along_x, y=era.y * along_y) for era in rig.eras)
    masses = tuple(replace(mass, x=mass.x * along_x, y=mass.y * along_y) for mass in rig.masses)
    mesh = stretched(rig.mesh, plate)
    return replace(rig, plate=plate, eras=eras, masses=masses, mesh=mesh)


@dataclass(frozen=True, eq=False)
class BeyondTolerances:
    """What deviates from the rig by more than tolerances."""

    loads: tuple[PointLoad | FingertipLoad, ...]
    """Loads on the plate, masses or a finger."""
    farthest: str
    """Least likely form error, in words."""
    deviation: float
    """Its rms in standard deviations, 0 where none is too large."""
    chance: float
    """Upper limit of the share of plates as written with one as unlikely."""
    error: float
    """Share of the response that is unexplained."""
    taper: tuple[float, float] | None = None
    """Relative rise of the thickness from the middle to the ends of x and of y, None where that is
    not what deviates most."""

    @property
    def kind(self) -> str:
        """Its name in reports."""
        if not self.loads:
            return "unnamed" if self.taper is None else "thickness"
        return "mass" if isinstance(self.loads[0], PointLoad) else "finger"


def match_with_form(
    plate: SensedPlate, observation: Responses, values: ComplexArray, drives: Sequence[int]
) -> tuple[Match, BeyondTolerances | None]:
    """Match values (f, e, s) of channels with a plate with form errors and loads.

    Returns the match, and what of the plate is beyond tolerances, None for nothing.
    """

    def matched(loads: Sequence[PointLoad | FingertipLoad], noise: float) -> Match:
        rig = replace(plate.rig, masses=(*plate.rig.masses, *loads))  # type: ignore[arg-type]
        sensed = plate_of(rig, observation, has_form=True)
        return match_plate(sensed, values, drives=drives, model_error=noise)

    noise = float(np.clip(matched((), _FIRST_NOISE).error, *_NOISE))
    best = matched((), noise)
    loads: list[PointLoad | FingertipLoad] = []
    further, fitted = _loads(best, values, drives, noise)
    while further and len(loads) < _MAX_LOADS:
        tried = [(each, matched((*loads, each), noise)) for each in further]
        load, found = best_by(tried, lambda each: -each[1].cost)
        if found.cost > best.cost - _CLEAR_LOAD:
            break
        best, loads = found, [*loads, load]
        further, fitted = _loads(best, values, drives, noise)
    mass = sum(each.mass for each in loads if isinstance(each, PointLoad))
    is_heavy = mass >= _HEAVY * plate.rig.plate.mass
    # A mass within tolerance is no fault, nor are form errors that would stand in for it.
    named = tuple(each for each in loads if is_heavy or not isinstance(each, PointLoad))
    if named:
        return best, BeyondTolerances(named, "", 0.0, 1.0, best.error)
    rises, slopes = _along_plate(best, observation.points, fitted)
    farthest, deviation, chance = _farthest(best, rises)
    if best.error <= MAX_FORM_ERROR and not deviation:
        return best, None
    taper = slopes if farthest == _THICKNESS else None
    return best, BeyondTolerances((), farthest, deviation, chance, best.error, taper)


def _farthest(match: Match, rises: FloatArray) -> tuple[str, float, float]:
    """The kind of form error that is least likely, its rms in standard deviations, its chance."""
    space = match.plate.model.space
    kinds = {words: match.x[space.of(kind)] for kind, words in _WORDS.items()}
    kinds[_THICKNESS] = rises
    found = [("", 0.0, 1.0)]
    for words, own in kinds.items():
        among = 1 if words == _THICKNESS else len(_WORDS)
        chance = among * float(chdtrc(len(own), own @ own))
        if chance < FALSE_ALARM:
            found.append((words, float(np.sqrt((own**2).mean())), chance))
    return best_by(found, lambda each: -each[2])


def _along_plate(
    match: Match, points: FloatArray, fitted: Linearization
) -> tuple[FloatArray, tuple[float, float]]:
    """Rise of the scales of sensors along both sides (2,), and the taper that explains it.

    The rise is in standard deviations, the taper relative at the ends of x and of y. The prior of a
    fit reduces scales, so that those of sound plates vary by less than their tolerance.
    """
    space, plate = match.plate.model.space, match.plate.rig.plate
    own = space.of("sensor_scale")[_searched(match)]
    scales = match.x[space.groups["sensor_scale"]]
    along = 2 * points / [plate.length, plate.width] - 1
    basis = np.linalg.qr(np.column_stack([np.ones(len(points)), along]))[0][:, 1:]
    shown = np.eye(len(points)) - linalg.inv(fitted.information)[np.ix_(own, own)]
    shown, rises = basis.T @ shown @ basis + _MIN_SHOWN * np.eye(2), basis.T @ scales
    thinner = basis @ linalg.solve(shown, rises) * space.std[space.groups["sensor_scale"]]
    x, y = -np.linalg.lstsq(along - along.mean(axis=0), thinner)[0]
    return linalg.solve(linalg.cholesky(shown, lower=True), rises), (float(x), float(y))


def _searched(match: Match) -> NDArray[np.bool_]:
    """Mask (p,) of the parameters that are searched beside free gains."""
    space = match.plate.model.space
    return space.uncertain & ~space.of("gain")


def _loads(
    match: Match, values: ComplexArray, drives: Sequence[int], noise: float
) -> tuple[list[PointLoad | FingertipLoad], Linearization]:
    """A mass and a finger where each would explain most, and the linearised match beside them.

    A finger lighter than a share of a fingertip is skipped.
    """
    plate, of_eras = match.plate, list(drives)
    model, mass = plate.model, plate.rig.plate.mass
    tip = plate.rig.fingertip or Fingertip()
    searched = _searched(match)
    found, by_x = responses_of(model, match.x, searched)
    points = _LOAD_GRID.centres(plate.rig.plate)
    by_mass = by_mass_at(model.at(match.x), points).transpose(3, 0, 2, 1)[:, :, of_eras]
    found, by_x = found[:, of_eras], by_x[:, :, of_eras]
    kept = np.isfinite(values) & ~match.outliers
    weight = kept / (noise * row_rms(values, kept)[:, :, None])
    _, left = project_gains(found, values, weight)

    def real(slopes: ComplexArray) -> FloatArray:
        """Derivatives (2 m, n) of all residuals."""
        own = projection_slopes(found, slopes, values, weight)[1][:, kept].T
        return np.concatenate([own.real, own.imag])

    residual = np.concatenate([left[kept].real, left[kept].imag])
    fitted = Linearization(match.x[searched], residual, real(by_x))
    of_finger = -tip.dynamic_stiffness(model.omega) / model.omega**2
    heaviest: list[PointLoad | FingertipLoad] = []
    for number, size in fitted.further(real(mass * by_mass))[:1]:
        x, y = points[number].tolist()
        heaviest.append(PointLoad(x, y, mass=size * mass))
    for number, size in fitted.further(real(of_finger[:, None, None] * by_mass))[:1]:
        if size >= _LIGHT:
            x, y = points[number].tolist()
            heaviest.append(FingertipLoad(x, y, tip.multiplied(min(size, _FIRM))))
    return heaviest, fitted


@dataclass(frozen=True)
class ExchangedSensors:
    """Sensors that are at each other's places."""

    pairs: Sequence[tuple[str, str]]
    """Each sensor with the one at whose place it is."""

    label = "PLACES"

    def __str__(self) -> str:
        """What is wrong, and what to do."""
        pairs = ", ".join(f"{name} at that of {place}" for name, place in self.pairs)
        return (
            f"sensors must be at their places, got responses that fit exchanged ones: {pairs}; "
            "correct their positions or names"
        )

    def put_right(self, observation: Responses) -> Responses:
        """The same responses, each sensor where it is."""
        names, points = observation.sensors, observation.points.copy()
        for name, place in self.pairs:
            points[names.index(name)] = observation.points[names.index(place)]
        return replace(observation, points=points)


@dataclass(frozen=True)
class ReversedAxes:
    """Axes along which a measurement is noted the wrong way round."""

    axes: tuple[str, ...]
    """"x", "y" or both of the places, or "frequency"."""
    error: float
    """Share of the responses that a coarse fit leaves unexplained."""
    error_as_written: float
    """The same as written."""
    is_wiring: bool
    """Whether exchanged channels explain the responses as well."""

    label = "PLACES"

    def __str__(self) -> str:
        """What is wrong, and what to do."""
        names = " and ".join(self.axes)
        found = (
            f"with {names} from the other end a coarse fit leaves {percent(self.error)} of the "
            f"responses unexplained, as written {percent(self.error_as_written)}"
        )
        if self.axes == (_FREQUENCY,):
            return f"frequencies must be those of their responses, got reversed ones: {found}"
        wiring = ", or plug the channels as the rig has them" if self.is_wiring else ""
        return (
            f"places of sensors must be from the corner from which those of ERAs are, got ones "
            f"mirrored in {names}: {found}; correct the positions of all{wiring}"
        )

    def put_right(self, observation: Responses, rig: Rig) -> Responses:
        """The same responses, noted the other way round."""
        size = np.array([rig.plate.length, rig.plate.width])
        mirrored = size * [axis in self.axes for axis in (_X, _Y)]
        step = -1 if _FREQUENCY in self.axes else 1
        points, values = np.abs(mirrored - observation.points), observation.values[::step]
        return replace(observation, points=points, values=values)


def reversed_axes(
    plate: SensedPlate, shapes: ShapeMatch, observation: Responses
) -> ReversedAxes | None:
    """Find the axes whose other direction clearly explains an observation better.

    Channels drive the ERAs of the rig. shapes: match of the observation with the rig's plate. None
    where that is good enough.
    """
    as_written = shapes.error_as_wired
    if not as_written > _MAX_COARSE_ERROR:
        return None
    tried = []
    for axes in ((_X,), (_Y,), (_X, _Y), (_FREQUENCY,)):
        put_right = ReversedAxes(axes, 0.0, as_written, False).put_right(observation, plate.rig)
        error = match_shapes(plate_of(plate.rig, put_right), put_right.values).error_as_wired
        is_wiring = shapes.error * _CLEARLY < error
        tried.append(ReversedAxes(axes, error, as_written, is_wiring))
    found = best_by(tried, lambda each: -each.error)
    return found if found.error < min(_MAX_COARSE_ERROR, _CLEARLY * as_written) else None


def exchanged_sensors(observation: Responses, model: ComplexArray) -> ExchangedSensors | None:
    """Find the sensors whose responses are those of the model (f, e, s) at another's place."""
    values = observation.values
    weight = np.isfinite(values) / row_rms(values)[:, :, None]
    gains, _ = project_gains(model, values, weight)
    measured = np.where(weight > 0, values * weight, 0j)
    predicted = np.nan_to_num(gains)[:, :, None] * model / row_rms(values)[:, :, None]
    coherence = _coherence(measured, predicted, weight > 0)
    sensors, places = linear_sum_assignment(-(coherence**2))
    names = observation.sensors
    pairs = [
        (names[sensor], names[place])
        for sensor, place in zip(sensors, places, strict=True)
        if coherence[sensor, sensor] < _OWN_PLACE
        and coherence[place, place] < _OWN_PLACE  # else two are at one place, which is no exchange
        and coherence[sensor, place] > _OTHER_PLACE
    ]
    return ExchangedSensors(pairs) if pairs else None


def _coherence(
    measured: ComplexArray, predicted: ComplexArray, used: NDArray[np.bool_]
) -> FloatArray:
    """Coherence (s, s) of each sensor's responses with the model's at each place."""
    inner = np.abs(np.einsum("fes,fep->sp", measured, predicted.conj()))
    own = (np.abs(measured) ** 2).sum(axis=(0, 1))
    other = np.einsum("fes,fep->sp", used.astype(float), np.abs(predicted) ** 2)
    return np.asarray(inner / np.sqrt(np.maximum(own[:, None] * other, 1e-300)))


def behind_glue(match: Match, values: ComplexArray, drives: Sequence[int]) -> NDArray[np.bool_]:
    """Mask (e,) of the channels whose exciters clearly act through a spring of glue.

    values (f, e, s), NaN for channels to be skipped; drives (e,): number of the ERA of each.
    """
    kept = np.isfinite(values) & ~match.outliers
    weight = kept / row_rms(values, kept)[:, :, None]
    gains, _ = project_gains(match.responses[:, list(drives)], values, weight)
    with np.errstate(divide="ignore"):
        sizes = np.log(np.abs(gains))
    sizes[~np.isfinite(sizes)] = np.nan
    driven = np.isfinite(sizes).any(axis=0)
    found = np.zeros(len(drives), dtype=bool)
    if driven.sum() < _MIN_CHANNELS:
        return found
    sizes[:, driven] -= np.nanmedian(sizes[:, driven], axis=0)
    omega = match.plate.model.omega
    for channel in np.flatnonzero(driven).tolist():
        era = match.rig.eras[drives[channel]]
        if isinstance(era, Exciter):
            others = driven & (np.arange(len(drives)) != channel)
            own = sizes[:, channel] - np.nanmedian(sizes[:, others], axis=1)
            found[channel] = _is_behind_glue(own, era.dynamic_stiffness(omega))
    return found


def _is_behind_glue(sizes: FloatArray, stiffness: ComplexArray) -> bool:
    """Whether logarithms of gains (f,) rise as those of an exciter [N/m] behind a spring."""
    shares = -np.log(np.abs(1 + stiffness / _GLUES[:, None]))  # (glues, f)
    left = np.vstack([sizes, sizes - shares])
    left -= np.nanmedian(left, axis=1, keepdims=True)
    without, *behind = np.nanmedian(np.abs(left), axis=1).tolist()
    best = int(np.argmin(behind))
    rise = np.ptp(shares[best][np.isfinite(sizes)])
    return bool(behind[best] < _EXPLAINS * without and rise > _RISES)


@dataclass(frozen=True)
class TurnedGrain:
    """A board whose grain runs along the other side than in its rig."""

    rig: Rig
    """The rig with the right grain."""
    along: str
    """Side along which the grain runs, `length` or `width`."""
    as_written: str
    """The side in the rig."""
    error: float
    """Share of the responses that a coarse fit leaves unexplained."""
    error_as_written: float
    """The same as written."""

    label = "GRAIN"

    def __str__(self) -> str:
        """What is wrong, and what to do."""
        return (
            f"plate.grain must be {self.along}, got {self.as_written}: with the grain along its "
            f"{self.along} a coarse fit leaves {percent(self.error)} of the responses unexplained, "
            f"along its {self.as_written} {percent(self.error_as_written)}; look at the veneer of "
            "its faces, and correct the rig"
        )


def turned_grain(
    plate: SensedPlate, shapes: ShapeMatch, observation: Responses
) -> TurnedGrain | None:
    """Find the board with the grain along the other side, if that clearly explains more.

    shapes: match of the observation with the rig's plate. None for a board without a grain.
    """
    rig = plate.rig
    if rig.plate.material.orthotropy is None:
        return None
    turned = replace(rig.plate, material=rig.plate.material.turned())
    other = replace(rig, plate=turned)
    other = replace(other, mesh=solved_for(other, rig.limits.frequency_max).mesh)
    sensed = plate_of(other, observation)
    error = match_shapes(sensed, observation.values).error
    if error > min(_MAX_COARSE_ERROR, _CLEARLY * shapes.error):
        return None
    as_written = rig.grain
    along = "length" if as_written == "width" else "width"
    return TurnedGrain(other, along, as_written, error, shapes.error)


@dataclass(frozen=True)
class BadSensor:
    """A sensor that is left out."""

    name: str
    scale: float
    """Its reading relative to what the others say, 0 for no signal."""

    @property
    def is_mute(self) -> bool:
        """Whether it hears next to nothing, so that no scale makes use of it."""
        return abs(self.scale) < _MUTE

    @property
    def why(self) -> str:
        """What is wrong with it."""
        if self.scale < _UPSIDE_DOWN:
            return f"is upside down (reads {self.scale:.2f} of what the others say): turn it over"
        if self.is_mute and self.scale:
            return (
                f"reads {self.scale:.2f} of what the others say: check that it is where its line "
                "says, and its cable"
            )
        return f"reads {self.scale:.2f} of what the others say" if self.scale else "reads nothing"


def dead_channels(
    plate: SensedPlate, observation: Responses, shapes: ShapeMatch | None = None
) -> NDArray[np.bool_]:
    """Mask (e,) of driven channels with a response far below the model's.

    shapes: if given, weak channels without the shape of an ERA, whose response is noise, count too.
    """
    share = np.abs(observation.values / plate.responses())
    dead = np.zeros(observation.values.shape[1], dtype=bool)
    for channel in np.flatnonzero(observation.measured):
        typical = np.nanmedian(share[:, channel])
        dead[channel] = typical < _DEAD
        if shapes is not None and typical < _FAINT:
            mac = np.nanmedian(shapes.mac[:, channel], axis=0)
            dead[channel] |= np.nanmax(mac) < _NO_SHAPE
    return dead


def usable_sensors(
    observation: Responses, dead: NDArray[np.bool_]
) -> tuple[Responses, tuple[BadSensor, ...]]:
    """Remove sensors without a signal from any live channel, and return these as well.

    Raises InputError if too few are left.
    """
    values = observation.values[:, ~dead]
    if not np.isfinite(values).any():
        return observation, ()
    silent = silent_sensors(replace(observation, values=values))
    check_enough_sensors(~silent, observation)
    mute = tuple(BadSensor(name, 0.0) for name in compress(observation.sensors, silent))
    return observation.without(silent), mute


def off_scale(observation: Responses, values: ComplexArray, match: Match) -> list[BadSensor]:
    """Find sensors with a scale unlike that of the others, if the plate fits."""
    if match.median_error > MAX_FIT_ERROR:
        return []
    finite = np.isfinite(values) & np.isfinite(match.predicted) & ~match.outliers
    model = np.where(finite, match.predicted, 0)
    measured = np.where(finite, values, 0)
    phase_factor = np.exp(-1j * np.angle((model.conj() * measured).sum(axis=2, keepdims=True)))
    inner = (model.conj() * measured * phase_factor).real.sum(axis=(0, 1))
    scale = inner / np.maximum((np.abs(model) ** 2).sum(axis=(0, 1)), 1e-300)
    scale = scale / np.median(scale)
    low, high = _SENSOR_SCALE
    return [
        BadSensor(name, float(value))
        for name, value in zip(observation.sensors, scale, strict=True)
        if not low <= value <= high
    ]
