"""Calibration of a rig by measured responses, without dead channels and outliers.

A fit is validated at sensors held out of it.
"""

import math
from dataclasses import replace
from itertools import compress

import numpy as np
from numpy.typing import NDArray

from model.arrays import ComplexArray, FloatArray, best_of
from model.calibration.calibration_result import (
    MAX_FIT_ERROR,
    MAX_OUTLIERS,
    Calibration,
    FittedParameter,
    HeldOutSensors,
    SensorScale,
)
from model.calibration.fit import CalibrationProblem, Fit, solve, start_at, without_form
from model.calibration.fitted_rig import (
    gain_rows,
    moved_eras,
    predicted_by,
    rig_of_fit,
    standard_error,
    uncertainty_of,
)
from model.calibration.responses import (
    LEAST_SENSORS,
    Responses,
    Screening,
    check_enough_sensors,
)
from model.calibration.sensed_plate import sensed_plate
from model.calibration.variable_projection import responses_of, row_rms
from model.errors import InputError
from model.identification.held_out import SHARE, relative_rms
from model.identification.parameters import KINDS
from model.processes import Progress, unseen
from model.quantities import in_display_unit
from model.rig.rig import Rig


def hold_out(problem: CalibrationProblem, fit: Fit, live: Responses) -> HeldOutSensors | None:
    """Fit without some of the live sensors of known scale, and predict their responses.

    Predicted by the rig as its file has it, without other form errors. None where too few are left
    to fit.
    """
    count = len(live.sensors)
    candidates = np.flatnonzero(~problem.free_scales | problem.free_scales.all())
    wanted = max(round(count / SHARE), 1)
    if count - wanted < LEAST_SENSORS or len(candidates) <= wanted:
        return None
    evenly_spaced = np.linspace(0, len(candidates) - 1, wanted + 2)[1:-1].round().astype(int)
    unseen = np.zeros(count, dtype=bool)
    unseen[candidates[evenly_spaced]] = True
    part = problem.without(unseen)
    seen = solve(part, fit)
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


def initial_responses(problem: CalibrationProblem) -> ComplexArray:
    """Responses (f, e, s) of the rig before the fit, with its gains."""
    plate = problem.plate
    gains = np.column_stack([era.gain(plate.model.frequencies) for era in plate.rig.eras])
    return np.asarray(gains[:, :, None] * plate.responses())


def relative_error(
    values: ComplexArray, predicted: ComplexArray, size: FloatArray, which: NDArray[np.bool_]
) -> float:
    """Root mean square of errors of some of the values (f, e, s), each relative to its row's size.

    Infinite where there is nothing to compare.
    """
    squares = np.where(which, np.abs(predicted - values) ** 2, np.nan)
    return relative_rms(squares, size[:, :, None] ** 2)


_WRONG_SCALE = 0.02  # common tolerance of sensors
_SIGNIFICANCE = 4.0  # standard errors
_MAX_GAIN = 5.0  # of a drive at a frequency relative to its median, either way
_MAX_SIDE = 4.0  # tolerances by which a side of the plate may be off


def calibrate(
    rig: Rig,
    responses: Responses,
    screened: Screening,
    *,
    all_scales: bool = False,
    progress: Progress = unseen,
) -> Calibration:
    """Fit a rig to responses measured on it, as `check_consistency` has found them.

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
        start = start_at(part, z)
        heard = start.used.sum(axis=(0, 1)) > np.isfinite(values).sum(axis=(0, 1)) / 2
        if heard.all():
            break
        dead[~dead] = ~heard  # elsewhere, or loose

    # All scales are free at first, so that a wrong one does not bias the fit.
    fit = _with_median_scale_one(part, solve(part, start))
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


def _identified(problem: CalibrationProblem, start: Fit) -> tuple[CalibrationProblem, Fit]:
    """Hold parameters that the data determine less than their prior does, and fit again."""
    fit = solve(problem, start)
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
        fit = solve(problem, replace(fit, z=z))


def _fit_error(problem: CalibrationProblem, fit: Fit) -> float:
    size = row_rms(problem.values, fit.used)
    return relative_error(problem.values, fit.predicted, size, fit.used)


def _check_outliers(problem: CalibrationProblem, fit: Fit) -> None:
    count = int(np.isfinite(problem.values).sum())
    out = count - int(fit.used.sum())
    if out > MAX_OUTLIERS * count:
        raise InputError(
            f"outliers must be at most {100 * MAX_OUTLIERS:g} % of the values, got {out} of "
            f"{count} ({100 * out / count:.0f} %); check that it is this plate, names and places "
            "of sensors and ERAs, and loose contacts"
        )


def _check_gains(problem: CalibrationProblem, fit: Fit) -> None:
    """Raise InputError for gains that no drive has: in these a fit hides what is another plate."""
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


def _check_suspensions(problem: CalibrationProblem, fit: Fit) -> None:
    """Raise InputError for exciters and feet whose stiffness is at a bound, as of another kind."""
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


def _at_bounds(problem: CalibrationProblem, fit: Fit) -> NDArray[np.bool_]:
    """Mask (n,) of the fitted values that are free and at a bound."""
    space = problem.plate.model.space
    distance = np.abs(np.array([space.lower, space.upper]) - fit.z).min(axis=0)
    return np.asarray(problem.free & (distance < 1e-6)[problem.plate.numbers])


def _check_sides(problem: CalibrationProblem, fit: Fit) -> None:
    """Raise InputError where the responses fit a plate of another size better."""
    if _fit_error(problem, fit) > MAX_FIT_ERROR:
        return
    plate, space = problem.plate.rig.plate, problem.plate.model.space
    offs = space.values(fit.z, "side").tolist()
    for key, side, off in zip(("length", "width"), (plate.length, plate.width), offs, strict=True):
        if abs(off) > _MAX_SIDE * KINDS["side"].std:
            raise wrong_size(f"plate.{key}", side, side + off)


def wrong_size(key: str, in_rig: float, measured: float) -> InputError:
    """What to say of a side [m] of the plate, by its key, that another one explains better."""
    rig_has, fits = (in_display_unit(side, "m", digits=4) for side in (in_rig, measured))
    return InputError(
        f"{key} must be that of the measured plate, got {rig_has} in the rig while responses fit "
        f"{fits}, as it looks; measure it, and correct the rig or take its own measurement"
    )


def _with_median_scale_one(problem: CalibrationProblem, fit: Fit) -> Fit:
    """Attribute the common scale of sensors to the gains, which do not tell them apart."""
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


def _report(
    problem: CalibrationProblem,
    fit: Fit,
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
        replace(era, gains=gain_rows(gains[:, number], live.frequencies) or era.gains)
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
