"""Calibration of a rig: fit it to measured responses, check it at held-out sensors, and report it.

Dead channels and outliers are left out. The rig of a fit has what a rig file can express, and
states how well it is then known.
"""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from itertools import compress
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from model.arrays import ComplexArray, FloatArray, best_of
from model.config.document import KeyPath
from model.errors import InputError
from model.estimate.calibration_fit import (
    CalibrationFit,
    CalibrationProblem,
    Parameter,
    clear,
    project_gains,
    responses_of,
    row_rms,
    sensed_plate,
    solve,
    start_at,
    without_form,
)
from model.estimate.fit import relative_rms
from model.estimate.identify import HELD_OUT_FOLDS, quality_rows, value_rows
from model.estimate.measurement import LEAST_SENSORS, Responses, Screening, check_enough_sensors
from model.estimate.space import KINDS, MASS_CELLS
from model.files.csv_file import as_frame
from model.processes import Progress, unseen
from model.quantities import counted, in_display_unit, percent, with_error
from model.rig.actuator_keys import KINDS as ACTUATOR_KEYS
from model.rig.rig import Rig, Uncertainty
from model.structure.attachments import Gain

MAX_FIT_ERROR = 0.25
"""Largest relative error at held-out sensors of an acceptable fit."""

MAX_OUTLIERS = 0.1
"""Largest share of values left out of an acceptable fit."""

_LEAST = 1e-4  # of an uncertainty; no fit is exact

# Relative error of values by idealisations of the model, of any but the loss factor, and of that:
# what form errors leave unexplained widens resonances by 0.4 % (root mean square over plates
# without noise).
_MODEL_ERROR, _LOSS_ERROR = 2e-3, 4e-3
_FOREIGN_MASS = KINDS["foreign_mass"].std * math.sqrt(MASS_CELLS.cell_count)  # of the plate's

_WRONG_SCALE = 0.02  # common tolerance of sensors
_SIGNIFICANCE = 4.0  # standard errors
_MAX_GAIN = 5.0  # of a drive at a frequency relative to its median, either way
_MAX_SIDE = 4.0  # tolerances by which a side of the plate may be off


@dataclass(frozen=True)
class FittedParameter:
    """A parameter with the rig's value and the fitted one.

    One that is not identified keeps the rig's value and has no standard error.
    """

    parameter: Parameter
    before: float
    value: float
    standard_error: float | None
    at_bound: bool

    @property
    def is_identified(self) -> bool:
        """Whether the data determine the value."""
        return self.standard_error is not None


@dataclass(frozen=True)
class SensorScale:
    """Scale of a sensor relative to the others' median, and its standard error."""

    name: str
    scale: float
    standard_error: float


@dataclass(frozen=True)
class MovedEra:
    """An ERA that is clearly not at the rig's place."""

    name: str
    before: tuple[float, float]
    """Place in the rig x, y [m]."""
    after: tuple[float, float]
    """Fitted place x, y [m]."""
    standard_error: tuple[float, float]
    """Standard errors of x and y [m]."""


@dataclass(frozen=True)
class HeldOutSensors:
    """Prediction at sensors held out of the fit.

    Errors are root mean squares over responses, each relative to all sensors' at its frequency and
    ERA.
    """

    sensors: tuple[str, ...]
    before: float
    """Error of the rig before the fit."""
    after: float
    """Error of the fitted rig."""
    median: float
    """Median error of the fitted rig."""
    unexplained: float
    """Error of the fitted rig that neither noise nor tolerances of the sensors explain."""


@dataclass(frozen=True, eq=False)
class Calibration:
    """Calibrated rig with all findings about the measurement."""

    rig: Rig
    parameters: tuple[FittedParameter, ...]
    moved: tuple[MovedEra, ...]
    """ERAs that are clearly at other places than in the rig before."""
    gains_error: FloatArray
    """Standard errors of the rig's gains (f, eras), NaN where not measured."""
    dead_sensors: tuple[str, ...]
    """Sensors left out of the fit, without a signal."""
    dead_eras: tuple[str, ...]
    """ERAs left out of the fit, which do not move the plate."""
    scales: tuple[SensorScale, ...]
    """Scales of the sensors where they are wrong, or of all sensors if requested."""
    outlier_count: int
    value_count: int
    error: float
    """Error of the fit with its form errors, relative as in `HeldOutSensors`."""
    chi2: float
    """chi² of that fit, about 1."""
    held_out: HeldOutSensors | None
    """Check at held-out sensors, None with too few of them."""
    sensors: tuple[str, ...]
    frequencies: FloatArray
    measured: ComplexArray
    """Measured responses (f, eras, s) [1/s²] of the live sensors, divided by their scales."""
    before: ComplexArray
    """Responses of the rig before."""
    after: ComplexArray
    """Responses of the fitted rig."""

    def to_frame(self) -> Any:
        """Parameters before and after, their units and errors, as a pandas DataFrame.

        A row a parameter; needs pandas.
        """
        return as_frame(
            {
                "parameter": [each.parameter.name for each in self.parameters],
                "unit": [each.parameter.unit for each in self.parameters],
                "before": [each.before for each in self.parameters],
                "after": [each.value for each in self.parameters],
                "standard_error": [each.standard_error for each in self.parameters],
            }
        )

    @property
    def is_good(self) -> bool:
        """Whether the fit predicts held-out sensors; False where there are none."""
        return self.held_out is not None and self.held_out.after <= MAX_FIT_ERROR


def calibrate(
    rig: Rig,
    responses: Responses,
    screened: Screening,
    *,
    all_scales: bool = False,
    progress: Progress = unseen,
) -> Calibration:
    """Fit a rig to responses measured on it, screened by `check_consistency`.

    all_scales: estimate the scale of every sensor, not only of wrong ones; progress: called with
    the fits done and all. Raises InputError if fewer than three sensors have a signal, for a plate
    of another size, for gains that no drive has, and for suspensions or feet at a bound.
    """
    dead, dead_eras = screened.dead_sensors.copy(), screened.dead_eras
    while True:
        check_enough_sensors(~dead, responses)
        live = responses.without(dead)
        values = live.values.copy()
        values[:, dead_eras] = np.nan
        plate = sensed_plate(rig, live.points, live.frequencies, masses=live.masses, has_form=True)
        part, z = CalibrationProblem.of(plate, values), np.zeros(plate.model.space.size)
        z[plate.numbers] = screened.start
        z, noise, used = start_at(part, z)
        heard = used.sum(axis=(0, 1)) > np.isfinite(values).sum(axis=(0, 1)) / 2
        if heard.all():
            break
        dead[~dead] = ~heard  # elsewhere, or loose

    # All scales are free at first, so that a wrong one does not bias the fit.
    fit = _with_median_scale_one(part, solve(part, z, noise, used))
    progress(1, 3)  # with all scales free, of what is identified, without held-out sensors
    free_scales = part.free_scales
    if not all_scales:
        scales, error = part.scales(fit.z), part.scale_errors(fit)
        free_scales = np.abs(scales - 1) > np.maximum(_WRONG_SCALE, _SIGNIFICANCE * error)
        fit = replace(fit, z=part.at_scales(fit.z, np.where(free_scales, scales, 1.0)))
    problem, found = _identified(replace(part, free_scales=free_scales), fit)
    if all_scales:
        found = _with_median_scale_one(problem, found)
    progress(2, 3)
    _check_sides(problem, found)
    _check_gains(problem, found)
    _check_suspensions(problem, found)
    _check_outliers(problem, found)
    report = _report(
        problem,
        found,
        live,
        dead_sensors=tuple(compress(responses.sensors, dead)),
        dead_eras=tuple(compress((era.name for era in rig.eras), dead_eras)),
    )
    progress(3, 3)
    return report


def _identified(
    problem: CalibrationProblem, start: CalibrationFit
) -> tuple[CalibrationProblem, CalibrationFit]:
    """Fix parameters that the data determine less than their prior does, and fit again."""
    fit = solve(problem, start.z, start.noise, start.used)
    while True:
        numbers = problem.plate.numbers
        excess = np.where(problem.free, fit.error[numbers] / problem.plate.largest_errors, 0)
        # Values of a plate that does not fit are meaningless.
        if not excess.max() > 1 or _fit_error(problem, fit) > MAX_FIT_ERROR:
            return problem, fit
        searched, z = problem.searched.copy(), fit.z.copy()
        least = numbers[best_of(excess)]
        searched[least], z[least] = False, 0.0
        problem = replace(problem, searched=searched)
        fit = solve(problem, z, fit.noise, fit.used)


def _with_median_scale_one(problem: CalibrationProblem, fit: CalibrationFit) -> CalibrationFit:
    """Attribute the common scale of sensors to the gains; responses do not separate both."""
    scales = problem.scales(fit.z)
    middle = float(np.median(scales))
    common = KINDS["sensor_scale"].std * math.sqrt(math.pi / (2 * len(scales)))  # of a median
    error = fit.error.copy()
    error[problem.plate.model.space.groups["sensor_scale"]] /= abs(middle)
    return replace(
        fit,
        z=problem.at_scales(fit.z, scales / middle),
        error=error,
        gains=fit.gains * middle,
        gains_error=np.hypot(fit.gains_error, common * np.abs(fit.gains)) * abs(middle),
        common_error=math.hypot(fit.common_error, common),
    )


def _fit_error(problem: CalibrationProblem, fit: CalibrationFit) -> float:
    size = row_rms(problem.values, fit.used)
    return relative_error(problem.values, fit.predicted, size, fit.used)


def _check_outliers(problem: CalibrationProblem, fit: CalibrationFit) -> None:
    count = int(np.isfinite(problem.values).sum())
    out = count - int(fit.used.sum())
    if out > MAX_OUTLIERS * count:
        raise InputError(
            f"outliers must be at most {100 * MAX_OUTLIERS:g} % of the values, got {out} of "
            f"{count} ({100 * out / count:.0f} %); check that it is this plate, names and places "
            "of sensors and ERAs, and loose contacts"
        )


def _check_sides(problem: CalibrationProblem, fit: CalibrationFit) -> None:
    """Raise InputError where the responses fit a plate of another size better."""
    if _fit_error(problem, fit) > MAX_FIT_ERROR:
        return
    plate, space = problem.plate.rig.plate, problem.plate.model.space
    offs = space.values(fit.z, "side").tolist()
    for key, side, off in zip(("length", "width"), (plate.length, plate.width), offs, strict=True):
        if abs(off) > _MAX_SIDE * KINDS["side"].std:
            raise wrong_size(f"plate.{key}", side, side + off)


def wrong_size(key: str, in_rig: float, measured: float) -> InputError:
    """Error for a side [m] of the plate, by its key, where another size fits the responses."""
    rig_has, fits = (in_display_unit(side, "m", digits=4) for side in (in_rig, measured))
    return InputError(
        f"{key} must be that of the measured plate, got {rig_has} in the rig while responses fit "
        f"{fits}, as it looks; measure it, and correct the rig or take its own measurement"
    )


def _check_gains(problem: CalibrationProblem, fit: CalibrationFit) -> None:
    """Raise InputError for gains that no drive has: they would hide another plate."""
    for number, era in enumerate(problem.plate.rig.eras):
        measured = np.isfinite(fit.gains_error[:, number])
        sizes, errors = (x[measured, number] for x in (np.abs(fit.gains), fit.gains_error))
        relative = sizes / np.median(sizes) if len(sizes) else sizes
        clear = np.abs(np.log(relative)) - _SIGNIFICANCE * errors / sizes
        if (clear > math.log(_MAX_GAIN)).any():
            raise InputError(
                f"gains of ERA {era.name} must be within a factor of {_MAX_GAIN:g} of their median "
                f"over frequency, got {relative.min():.2g} to {relative.max():.2g} of it, as no "
                "drive has them; check that it is this plate, its material and the places of "
                "sensors, and measure at more places"
            )


def _check_suspensions(problem: CalibrationProblem, fit: CalibrationFit) -> None:
    """Raise InputError for exciters and feet with a stiffness at its bound, of another kind."""
    plate = problem.plate
    factors: dict[str, float] = {}
    feet: dict[str, float] = {}
    for row, value, is_at_bound in zip(
        plate.rows, plate.values(fit.z), _at_bounds(problem, fit), strict=True
    ):
        if is_at_bound and row.kind == "stiffness" and row in plate.of_exciters:
            factors[row.era] = value / row.of(plate.rig)
        elif is_at_bound and row.foot:
            feet[row.foot] = value / row.of(plate.rig)
    if factors:
        raise InputError(
            f"stiffness of {', '.join(factors)} must be about that of the rig, got "
            f"{', '.join(f'{each:.2g}' for each in factors.values())} times it, the bound of what "
            "is searched; check resonance and resonance_is of these: whether free or mounted "
            "(era plate show prints where the glued magnets resonate), and by era rig check that "
            "they are glued"
        )
    if feet:
        raise InputError(
            f"stiffness of feet {', '.join(feet)} must be about that of the rig, got "
            f"{', '.join(f'{each:.2g}' for each in feet.values())} times it, the bound of what is "
            "searched; check their kind, their places and that all of them touch"
        )


def _at_bounds(problem: CalibrationProblem, fit: CalibrationFit) -> NDArray[np.bool_]:
    """Mask (n,) of the fitted values that are free and at a bound."""
    space = problem.plate.model.space
    distance = np.abs(np.array([space.lower, space.upper]) - fit.z).min(axis=0)
    return np.asarray(problem.free & (distance < 1e-6)[problem.plate.numbers])


def _report(
    problem: CalibrationProblem,
    fit: CalibrationFit,
    live: Responses,
    *,
    dead_sensors: tuple[str, ...],
    dead_eras: tuple[str, ...],
) -> Calibration:
    fitted, scales, before = problem.plate, problem.scales(fit.z), problem.plate.rig
    plain = without_form(problem, fit)
    rig = rig_of_fit(problem, fit, plain[0])
    responses, gains = predicted_by(rig, problem, live.points, fit)
    eras = tuple(
        replace(era, gains=stated_gains(gains[:, number], live.frequencies) or era.gains)
        for number, era in enumerate(rig.eras)
    )
    parameters = tuple(
        FittedParameter(
            row,
            row.of(before),
            float(value),
            standard_error(before, row, float(value), float(error), fit.dampers) if free else None,
            bool(bound),
        )
        for row, value, error, free, bound in zip(
            fitted.rows,
            fitted.values(fit.z),
            fitted.errors(fit.z, fit.error),
            problem.free,
            _at_bounds(problem, fit),
            strict=True,
        )
    )
    held_out = hold_out(problem, fit, live)
    uncertainty = uncertainty_of(before.uncertainty, problem, fit, plain, parameters, held_out)
    measured_count = int(np.isfinite(problem.values).sum())
    return Calibration(
        rig=replace(rig, eras=eras, uncertainty=uncertainty),
        parameters=parameters,
        moved=moved_eras(problem, fit),
        gains_error=np.hypot(fit.gains_error, np.abs(gains) - np.abs(fit.gains)),
        dead_sensors=dead_sensors,
        dead_eras=dead_eras,
        scales=tuple(
            SensorScale(name, float(scale), float(error))
            for name, scale, error, free in zip(
                live.sensors, scales, problem.scale_errors(fit), problem.free_scales, strict=True
            )
            if free
        ),
        outlier_count=measured_count - int(fit.used.sum()),
        value_count=measured_count,
        error=_fit_error(problem, fit),
        chi2=fit.chi2,
        held_out=held_out,
        sensors=live.sensors,
        frequencies=live.frequencies,
        measured=problem.values / scales,
        before=initial_responses(problem),
        after=gains[:, :, None] * responses,
    )


def rig_of_fit(problem: CalibrationProblem, fit: CalibrationFit, z: FloatArray) -> Rig:
    """Rig of the fit z (p,) without form errors; ERAs move where they clearly are elsewhere.

    Its gains are those of the rig before.
    """
    rig = problem.plate.rig_at(z)
    moves = {moved.name: moved.after for moved in moved_eras(problem, fit)}
    eras = tuple(
        replace(era, x=moves[era.name][0], y=moves[era.name][1]) if era.name in moves else era
        for era in rig.eras
    )
    return replace(rig, eras=eras)


def moved_eras(problem: CalibrationProblem, fit: CalibrationFit) -> tuple[MovedEra, ...]:
    """List the ERAs that are off their places by several standard errors."""
    rig, space, found = problem.plate.rig, problem.plate.model.space, []
    sides = np.array([rig.plate.length, rig.plate.width])
    off = np.where(clear(fit), fit.z, 0.0)
    places, errors = (space.values(x, "place").reshape(-1, 2) for x in (off, fit.error))
    for era, place, error in zip(rig.eras, places, errors, strict=True):
        at = np.clip(np.array([era.x, era.y]) + place, 0, sides)
        if np.abs(at - [era.x, era.y]).max() > 0:
            found.append(
                MovedEra(
                    era.name,
                    (era.x, era.y),
                    (float(at[0]), float(at[1])),
                    (float(error[0]), float(error[1])),
                )
            )
    return tuple(found)


def predicted_by(
    rig: Rig, problem: CalibrationProblem, points: FloatArray, fit: CalibrationFit
) -> tuple[ComplexArray, ComplexArray]:
    """Responses (f, e, s) of a rig at points (s, 2) [m], and its gains (f, e) that fit best."""
    known = problem.plate
    model = sensed_plate(rig, points, known.model.frequencies, masses=known.masses).responses()
    weight = fit.used / fit.noise[:, :, None]
    gains, _ = project_gains(model * problem.scales(fit.z), problem.values, weight)
    return model, gains


def initial_responses(problem: CalibrationProblem) -> ComplexArray:
    """Responses (f, e, s) of the rig before the fit, with its gains."""
    plate = problem.plate
    gains = np.column_stack([era.gain(plate.model.frequencies) for era in plate.rig.eras])
    return np.asarray(gains[:, :, None] * plate.responses())


def stated_gains(gains: ComplexArray, frequencies: FloatArray) -> tuple[Gain, ...]:
    """Gains of an ERA for a rig, of those among gains (f,) that are known."""
    known = np.isfinite(gains) & (gains != 0)
    return tuple(
        (float(f), float(abs(gain)), float(np.angle(gain)))
        for f, gain in zip(frequencies[known], gains[known], strict=True)
    )


def standard_error(
    rig: Rig, parameter: Parameter, value: float, error: float, dampers: float
) -> float:
    """Standard error of a value: that of the fit, of the model, and of the mass it scales with.

    dampers: their effect on the responses relative to that of the plate's own losses, by which an
    error of the model in the former looks like one of the latter.
    """
    share = math.hypot(_MODEL_ERROR, _mass_scale_error(rig))
    if parameter.kind == "loss_factor":
        share = math.hypot(_LOSS_ERROR, _MODEL_ERROR * dampers)
    return math.hypot(error, share * value)


def _mass_scale_error(rig: Rig) -> float:
    """Standard error of the whole mass, relative: all that is fitted but losses scales with it."""
    sides = KINDS["side"].std / np.array([rig.plate.length, rig.plate.width])
    return float(np.hypot(_FOREIGN_MASS, np.linalg.norm(sides)))


def hold_out(
    problem: CalibrationProblem, fit: CalibrationFit, live: Responses
) -> HeldOutSensors | None:
    """Fit without some of the live sensors of known scale, and predict their responses.

    The prediction is that of the rig as its file has it, without other form errors. Returns None
    where too few sensors are left to fit.
    """
    count = len(live.sensors)
    candidates = np.flatnonzero(~problem.free_scales | problem.free_scales.all())
    wanted = max(round(count / HELD_OUT_FOLDS), 1)
    if count - wanted < LEAST_SENSORS or len(candidates) <= wanted:
        return None
    evenly_spaced = np.linspace(0, len(candidates) - 1, wanted + 2)[1:-1].round().astype(int)
    unseen = np.zeros(count, dtype=bool)
    unseen[candidates[evenly_spaced]] = True
    part = problem.without(unseen)
    seen = solve(part, fit.z, fit.noise, fit.used)
    rig = rig_of_fit(part, seen, without_form(part, seen)[0])
    scales = problem.scales(fit.z)
    responses, gains = predicted_by(
        rig, problem, live.points, replace(fit, used=fit.used & ~unseen)
    )
    predicted = gains[:, :, None] * responses * scales
    size = row_rms(problem.values)
    which = fit.used & unseen
    error = np.abs(predicted - problem.values) / size[:, :, None]
    own = problem.plate.model.space.of("sensor_scale", "sensor_place")
    _, read = responses_of(problem.plate.model, fit.z, own)
    variance = (np.abs(gains[:, :, None] * read) ** 2).sum(axis=0) + 2 * fit.noise[:, :, None] ** 2
    left = np.median(error[which] ** 2) - np.median((variance / size[:, :, None] ** 2)[which])
    return HeldOutSensors(
        tuple(compress(live.sensors, unseen)),
        relative_error(
            problem.values, initial_responses(problem) * scales, size, unseen[None, None]
        ),
        relative_error(problem.values, predicted, size, which),
        float(np.median(error[which])),
        math.sqrt(max(left, 0.0) / math.log(2)),  # the median of |z|² is log 2 of its mean
    )


def relative_error(
    values: ComplexArray, predicted: ComplexArray, size: FloatArray, which: NDArray[np.bool_]
) -> float:
    """Rms error of the values of a mask (f, e, s), each relative to its row's size.

    Infinite for an empty mask.
    """
    squares = np.where(which, np.abs(predicted - values) ** 2, np.nan)
    return relative_rms(squares, size[:, :, None] ** 2)


def uncertainty_of(
    before: Uncertainty,
    problem: CalibrationProblem,
    fit: CalibrationFit,
    plain: tuple[FloatArray, FloatArray],
    parameters: Sequence[FittedParameter],
    held_out: HeldOutSensors | None,
) -> Uncertainty:
    """Uncertainty of a calibrated rig, for its file.

    It excludes the error of the whole mass, with which all values scale and no pattern changes.
    Thickness stands for the plate's rigidity: 1 % of modulus shifts modes as 0.5 % of thickness
    does. Field is the part of the fit's fields that the rig lacks, since it cannot express form
    errors, and at least what held-out sensors leave unexplained. Gain and phase are those of the
    best gains for such fields, as the sensors read them: other errors move gains and fields in
    opposite directions. What is not identified keeps the value of the rig before.
    """
    errors = problem.plate.errors(fit.z, fit.error)
    # An exciter damps and pushes by its coil: the share of its suspension shows little alone.
    by_coils = [each for each in problem.plate.of_exciters if each.kind == "damping"]
    stated = [one for one in parameters if one.parameter not in by_coils]
    relative = {
        kind: [
            math.hypot(
                float(error) / one.value,
                math.hypot(_LOSS_ERROR, _MODEL_ERROR * fit.dampers)
                if kind == "loss_factor"
                else _MODEL_ERROR,
            )
            for one, error in zip(parameters, errors, strict=True)
            if one in stated and one.parameter.kind == kind and one.is_identified and one.value > 0
        ]
        for kind in ("modulus", "loss_factor", "stiffness", "damping")
    }
    known = {
        kind: len(values) == sum(one.parameter.kind == kind for one in stated)
        for kind, values in relative.items()
    }

    def rms(kind: str) -> float:
        return _rms(relative[kind] or [0.0])

    gains = {}
    lacking = lacking_of(problem, fit, plain[0])
    known_gains = np.isfinite(fit.readings_error[0]) & np.isfinite(lacking)
    if known_gains.any(axis=0).all():
        field = max(_rms(lacking[known_gains]), held_out.unexplained if held_out else 0.0)
        # The best gain of a field that is off by so much at n sensors: but at resonances, masses
        # and stiffness that are off change a field in phase with it.
        off = field / np.sqrt(fit.used.sum(axis=2)[known_gains])
        gain, phase = (
            max(_rms(np.hypot(share * off, error[known_gains])), _LEAST)
            for share, error in zip((1, math.sqrt(0.5)), fit.readings_error, strict=True)
        )
        gains = {"gain": _rounded(gain), "phase_deg": _rounded(math.degrees(phase))}
        gains |= {"field": _rounded(field), "common_gain": _rounded(fit.common_error)}
    losses = (
        max(rms("loss_factor"), rms("damping"))
        if known["loss_factor"] and known["damping"]
        else math.log(before.damping)
    )
    fitted = {
        "stiffness": _rounded(rms("stiffness")) if known["stiffness"] else before.stiffness,
        "damping": 1 + _rounded(math.exp(losses) - 1),
    }
    fitted["place"] = _rounded(place_error(problem, fit, before.place))
    feet = [
        float(error) / one.value if one.is_identified else before.supports
        for one, error in zip(parameters, errors, strict=True)
        if one.parameter.foot
    ]
    if feet:
        fitted["supports"] = _rounded(math.hypot(_rms(feet), _MODEL_ERROR))
    if known["modulus"]:
        # The rig's modulus is that of frequencies with form errors, whatever part is theirs.
        of_plain, value = problem.plate.errors(*plain)[0], problem.plate.values(plain[0])[0]
        of_modulus = math.hypot(of_plain / value, _MODEL_ERROR)
        fitted |= Uncertainty.of_frequency(_rounded(of_modulus / 2))
    return Uncertainty.clipped(**asdict(before) | fitted | gains)


def lacking_of(problem: CalibrationProblem, fit: CalibrationFit, z: FloatArray) -> FloatArray:
    """Part of a fit's responses that its rig without form errors, z (p,), lacks, relative (f, e).

    ERAs stay at the places of the fit, since a rig states the errors of places.
    """
    at_places = np.where(problem.plate.model.space.of("place"), fit.z, z)
    model = problem.plate.responses(at_places)
    gains, _ = project_gains(model, problem.values, fit.used / fit.noise[:, :, None])
    predicted = gains[:, :, None] * model
    squares = np.where(fit.used, np.abs(predicted - fit.predicted) ** 2, np.nan)
    size = row_rms(fit.predicted, fit.used)
    with np.errstate(divide="ignore", invalid="ignore"):
        shares = np.nansum(squares, axis=2) / fit.used.sum(axis=2)
    return np.asarray(np.sqrt(shares) / size)


def place_error(problem: CalibrationProblem, fit: CalibrationFit, before: float) -> float:
    """Root mean square error of the places of ERAs in the rig of a fit, along a side [m].

    Where the fit does not clearly have another place, the error of the kept one counts; before:
    error of places that the data determine less than their prior does.
    """
    space = problem.plate.model.space
    kept, error = (space.values(x, "place") for x in (np.where(clear(fit), 0.0, fit.z), fit.error))
    by_data = error < math.sqrt(0.5) * KINDS["place"].std
    of_each = np.where(by_data, np.hypot(np.hypot(kept, error), KINDS["place"].theory), before)
    return _rms(of_each)


def _rms(values: ArrayLike) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def _rounded(value: float) -> float:
    """To two digits: an error is hardly known better."""
    return float(f"{value:.2g}")


def standard_errors(calibration: Calibration) -> dict[KeyPath, float]:
    """Standard errors of the values that a rig's file states, by the path of their key."""
    rig, found = calibration.rig, dict[KeyPath, float]()
    for each in calibration.parameters:
        parameter = each.parameter
        if each.standard_error is None:
            continue
        if parameter.foot:
            path: KeyPath = ("supports", parameter.foot, "stiffness")
        elif parameter.era:
            keys = ACTUATOR_KEYS[type(rig.era(parameter.era))].keys
            path = ("eras", parameter.era, keys[parameter.field or parameter.kind])
        elif parameter.kind == "loss_factor":
            path = ("plate", "loss_factor")
        elif rig.laminate is None:
            path = ("plate", "material", next(iter(rig.plate.material.moduli)))
        else:
            continue  # its modulus is that of all layers together
        found[path] = each.standard_error
    return found


def change_rows(calibration: Calibration) -> list[str]:
    """Table of all parameters, and of ERAs that are not at the rig's places."""
    moved = [
        (
            f"{each.name} place",
            _millimetres(each.before),
            f"{_millimetres(each.after)} ± {_millimetres(each.standard_error)} mm",
        )
        for each in calibration.moved
    ]
    return value_rows([*map(_change, calibration.parameters), *moved])


def gain_rows(calibration: Calibration) -> list[str]:
    """Lines of all ERAs: median and range over frequency of their gains, with standard error."""
    rows = []
    for number, era in enumerate(calibration.rig.eras):
        if era.name in calibration.dead_eras or not era.gains:
            rows.append(f"{era.name} gain  not measured")
            continue
        size = 100 * (np.array([row[1] for row in era.gains]) - 1)
        phase = np.degrees([row[2] for row in era.gains])
        error = float(np.nanmedian(calibration.gains_error[:, number]))
        rows.append(
            f"{era.name} gain  {np.median(size):+.1f} % ({size.min():+.1f} to {size.max():+.1f}), "
            f"phase {np.median(phase):+.1f}° ({phase.min():+.1f} to {phase.max():+.1f}), "
            f"± {100 * error:.2g} % at {counted(len(size), 'frequency', plural='frequencies')}"
        )
    return rows


def finding_rows(calibration: Calibration) -> list[str]:
    """Lines of faults of the measurement, and of parameters that are not identified."""
    rows = [f"sensor {name}: no signal, left out" for name in calibration.dead_sensors]
    rows += [f"ERA {name}: no motion; gains unchanged" for name in calibration.dead_eras]
    rows += [
        f"sensor {scale.name}: scale {with_error(scale.scale, scale.standard_error)} of the others"
        for scale in calibration.scales
    ]
    if calibration.outlier_count:
        rows.append(
            f"{calibration.outlier_count} of {calibration.value_count} values left out as outliers"
        )
    fixed = [p.parameter.name for p in calibration.parameters if not p.is_identified]
    if fixed:
        rows.append(f"not identified, rig's value kept: {', '.join(fixed)}")
    return rows


def check_rows(calibration: Calibration) -> list[str]:
    """Lines of the new rig's uncertainty and of the held-out check."""
    held, known = calibration.held_out, calibration.rig.uncertainty
    if held is None:
        return quality_rows(known, beside=f"error of the fit {percent(calibration.error)}")
    return quality_rows(
        known,
        held_out=f"sensors {', '.join(held.sensors)}",
        error=held.after,
        beside=f"by the old rig {percent(held.before)}",
    )


def calibration_json(calibration: Calibration, before: Rig) -> dict[str, Any]:
    """All results for programs, units in the keys or beside the values."""
    held_out = calibration.held_out
    frequencies = calibration.frequencies
    return {
        "parameters": [
            {
                "name": fitted.parameter.name,
                "era": fitted.parameter.era or None,
                "foot": fitted.parameter.foot or None,
                "kind": fitted.parameter.kind,
                "unit": fitted.parameter.unit,
                "before": fitted.before,
                "after": fitted.value,
                "standard_error": fitted.standard_error,
                "identified": fitted.is_identified,
                "at_bound": fitted.at_bound,
            }
            for fitted in calibration.parameters
        ],
        "gains": {
            era.name: {
                "frequency_hz": [row[0] for row in era.gains],
                "magnitude": [row[1] for row in era.gains],
                "phase_deg": np.degrees([row[2] for row in era.gains]).tolist(),
                "standard_error": [
                    float(error)
                    for error in calibration.gains_error[:, number]
                    if np.isfinite(error)
                ],
            }
            for number, era in enumerate(calibration.rig.eras)
        },
        "moved_eras": [
            {
                "era": moved.name,
                "before_m": list(moved.before),
                "after_m": list(moved.after),
                "standard_error_m": list(moved.standard_error),
            }
            for moved in calibration.moved
        ],
        "uncertainty": asdict(calibration.rig.uncertainty),
        "not_identified": [p.parameter.name for p in calibration.parameters if not p.is_identified],
        "dead_sensors": list(calibration.dead_sensors),
        "dead_eras": list(calibration.dead_eras),
        "sensor_scales": {
            scale.name: {"scale": scale.scale, "standard_error": scale.standard_error}
            for scale in calibration.scales
        },
        "sensors": list(calibration.sensors),
        "drive_frequencies_hz": frequencies.tolist(),
        "values": calibration.value_count,
        "outliers": calibration.outlier_count,
        "fit_error": calibration.error,
        "chi2": calibration.chi2,
        "held_out": None
        if held_out is None
        else {
            "sensors": list(held_out.sensors),
            "error_before": held_out.before,
            "error_after": held_out.after,
            "median_error_after": held_out.median,
        },
        "good": calibration.is_good,
        "fingerprint_before": before.fingerprint,
        "fingerprint_after": calibration.rig.fingerprint,
    }


def _millimetres(place: tuple[float, float]) -> str:
    return f"({1e3 * place[0]:.1f}, {1e3 * place[1]:.1f})"


def _change(fitted: FittedParameter) -> tuple[str, str, str]:
    parameter = fitted.parameter
    before = in_display_unit(fitted.before, parameter.unit, digits=5)
    if fitted.standard_error is None:
        return parameter.name, before, "not identified"
    note = "  (at its bound)" if fitted.at_bound else ""
    after = with_error(fitted.value, fitted.standard_error, parameter.unit)
    share = f" ({100 * (fitted.value / fitted.before - 1):+.1f} %)" if fitted.before else ""
    return parameter.name, before, f"{after}{share}{note}"
