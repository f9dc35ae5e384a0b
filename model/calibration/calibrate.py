"""Calibration of a rig by measured responses, without dead channels and outliers."""

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from model.arrays import ComplexArray, FloatArray
from model.calibration.calibration_result import (
    MAX_FIT_ERROR,
    MAX_OUTLIERS,
    Calibration,
    FittedParameter,
    SensorScale,
)
from model.calibration.calibration_screening import (
    check_enough_sensors,
    sensors_off_model,
    silent_eras,
    silent_sensors,
)
from model.calibration.fit import Fit, Problem, misfit, solve
from model.calibration.fitted_rig import (
    gain_rows,
    moved_eras,
    predicted_by,
    rig_of_fit,
    standard_error,
    uncertainty_of,
)
from model.calibration.form_errors import SENSOR_SCALE, SIDE, FormModel, form_model
from model.calibration.form_fit import FormFit, solve_with_form
from model.calibration.held_out import hold_out, initial_responses, relative_error
from model.calibration.parameters import Parameter, parameters_of, starts
from model.calibration.responses import Responses
from model.calibration.variable_projection import row_rms
from model.choice import best_by, best_of, ranked_by
from model.errors import InputError
from model.rig.rig import Rig
from model.vibration.parametric_plate import ParametricPlate, parametric_plate

_STARTS = 2  # those with the least misfit of shapes
_WRONG_SCALE = 0.02  # common tolerance of sensors
_SIGNIFICANCE = 4.0  # standard errors
_MAX_SIDE = 4.0  # tolerances by which a side of the plate may be off


def calibrate(rig: Rig, responses: Responses, *, all_scales: bool = False) -> Calibration:
    """Fit a rig to responses measured on it.

    all_scales: estimate the scale of every sensor, not only of wrong ones. Raises InputError if
    fewer than three sensors have a signal or nothing was driven.
    """
    alive, dead_eras = ~silent_sensors(responses), silent_eras(responses)
    values = responses.values.copy()
    values[:, dead_eras] = np.nan
    check_enough_sensors(alive, responses)
    plate = parametric_plate(rig, responses.points, responses.frequencies)
    parameters = parameters_of(rig)

    # All scales are free at first, so that a wrong one does not bias the fit.
    problem = _problem(rig, plate, parameters, values, alive)
    fit = _best_fit(problem)
    relative = fit.scales / np.median(fit.scales)
    unlike = sensors_off_model(problem, fit, relative)
    if unlike.any():
        alive[alive] = ~unlike
        check_enough_sensors(alive, responses)
        relative = relative[~unlike] / np.median(relative[~unlike])
        problem = _problem(rig, plate, parameters, values, alive)
        fit = solve(problem, fit.x, relative)
        relative = fit.scales / np.median(fit.scales)
    error = fit.scales_error / np.abs(np.median(fit.scales))
    wrong = np.abs(relative - 1) > np.maximum(_WRONG_SCALE, _SIGNIFICANCE * error)

    free_scales = np.ones(len(wrong), dtype=bool) if all_scales else wrong
    if not all_scales:
        relative = np.where(wrong, relative, 1.0)
    problem = replace(problem, free_scales=free_scales)
    points = responses.points[alive]
    model = form_model(rig, points, responses.frequencies)
    problem, found = _identified(problem, model, solve(problem, fit.x, relative))
    if all_scales:
        found = _with_median_scale_one(found)
    _check_sides(problem, model, found)
    _check_outliers(problem, found)
    names = tuple(name for name, live in zip(responses.sensors, alive, strict=True) if live)
    return _report(
        problem,
        model,
        found,
        points=points,
        names=names,
        frequencies=responses.frequencies,
        dead_sensors=tuple(
            name for name, live in zip(responses.sensors, alive, strict=True) if not live
        ),
        dead_eras=tuple(era.name for era, dead in zip(rig.eras, dead_eras, strict=True) if dead),
    )


def _problem(
    rig: Rig,
    plate: ParametricPlate,
    parameters: tuple[Parameter, ...],
    values: ComplexArray,
    alive: NDArray[np.bool_],
) -> Problem:
    """Problem of the live sensors with all parameters and scales free."""
    count = int(alive.sum())
    return Problem(
        rig,
        plate.at(alive),
        parameters,
        values[:, :, alive],
        np.ones(len(parameters), dtype=bool),
        np.ones(count, dtype=bool),
    )


def _best_fit(problem: Problem) -> Fit:
    """Fit from several starts, since a fit finds only the nearest minimum; return the best."""
    possible = starts(problem.parameters)
    nearest = ranked_by(possible, lambda x: -misfit(problem, x))[:_STARTS]
    ones = np.ones(problem.values.shape[2])
    fits = [solve(problem, each, ones) for each in nearest]
    return best_by(fits, lambda fit: -misfit(problem, fit.x))


def _identified(problem: Problem, model: FormModel, start: Fit) -> tuple[Problem, FormFit]:
    """Hold parameters that the data determine less than their prior does, and fit again."""
    prior = np.array([parameter.prior_std for parameter in problem.parameters])
    own = np.array([parameter.start for parameter in problem.parameters])
    fit = solve_with_form(problem, model, start)
    while True:
        excess = np.where(problem.free, fit.x_error / prior, 0)
        # Values of a plate that does not fit are meaningless.
        if not excess.max() > 1 or _fit_error(problem, model, fit) > MAX_FIT_ERROR:
            return problem, fit
        free = problem.free.copy()
        free[best_of(excess)] = False
        problem = replace(problem, free=free)
        fit = solve_with_form(problem, model, replace(fit, x=np.where(free, fit.x, own)))


def _fit_error(problem: Problem, model: FormModel, fit: FormFit) -> float:
    responses, _ = model.responses(problem.parameters, fit.x, fit.form)
    predicted = fit.gains[:, :, None] * responses * fit.scales
    return relative_error(problem.values, predicted, row_rms(problem.values, fit.used), fit.used)


def _check_outliers(problem: Problem, fit: FormFit) -> None:
    count = int(np.isfinite(problem.values).sum())
    out = count - int(fit.used.sum())
    if out > MAX_OUTLIERS * count:
        raise InputError(
            f"outliers must be at most {100 * MAX_OUTLIERS:g} % of the values, got {out} of "
            f"{count} ({100 * out / count:.0f} %); check that it is this plate, names and places "
            "of sensors and ERAs, and loose contacts"
        )


def _check_sides(problem: Problem, model: FormModel, fit: FormFit) -> None:
    """Raise InputError where the responses fit a plate of another size better."""
    if _fit_error(problem, model, fit) > MAX_FIT_ERROR:
        return
    plate = problem.rig.plate
    for key, side, off in zip(
        ("length", "width"), (plate.length, plate.width), fit.form[model.sides], strict=True
    ):
        if abs(off) > _MAX_SIDE:
            found = side + SIDE * float(off)
            raise InputError(
                f"plate.{key} must be that of the measured plate, got {1e3 * side:.4g} mm in the "
                f"rig while responses fit {1e3 * found:.4g} mm, as it looks; measure it, and "
                "correct the rig or take its own measurement"
            )


def _with_median_scale_one(fit: FormFit) -> FormFit:
    """Attribute the common scale of sensors to the gains, which do not tell them apart."""
    middle = float(np.median(fit.scales))
    common = SENSOR_SCALE * math.sqrt(math.pi / (2 * len(fit.scales)))  # of a median
    return replace(
        fit,
        scales=fit.scales / middle,
        scales_error=fit.scales_error / abs(middle),
        gains=fit.gains * middle,
        gains_error=np.hypot(fit.gains_error, common * np.abs(fit.gains)) * abs(middle),
    )


def _report(
    problem: Problem,
    model: FormModel,
    fit: FormFit,
    *,
    points: FloatArray,
    names: tuple[str, ...],
    frequencies: FloatArray,
    dead_sensors: tuple[str, ...],
    dead_eras: tuple[str, ...],
) -> Calibration:
    before = problem.rig
    rig = rig_of_fit(problem, model, fit)
    responses, gains = predicted_by(rig, problem, points, fit)
    eras = tuple(
        replace(era, gains=gain_rows(gains[:, number], frequencies) or era.gains)
        for number, era in enumerate(rig.eras)
    )
    parameters = tuple(
        FittedParameter(
            parameter,
            parameter.value(float(x)),
            standard_error(before, parameter, float(x), float(error)) if free else None,
            bool(free and min(x - parameter.lower, parameter.upper - x) < 1e-6),
        )
        for parameter, x, error, free in zip(
            problem.parameters, fit.x, fit.x_error, problem.free, strict=True
        )
    )
    held_out = hold_out(problem, model, fit, points, names)
    uncertainty = uncertainty_of(before.uncertainty, problem, fit, parameters, held_out, gains)
    measured_count = int(np.isfinite(problem.values).sum())
    return Calibration(
        rig=replace(rig, eras=eras, uncertainty=uncertainty),
        parameters=parameters,
        moved=moved_eras(before, model, fit),
        gains_error=np.hypot(fit.gains_error, np.abs(gains) - np.abs(fit.gains)),
        dead_sensors=dead_sensors,
        dead_eras=dead_eras,
        scales=tuple(
            SensorScale(name, float(scale), float(error))
            for name, scale, error, free in zip(
                names, fit.scales, fit.scales_error, problem.free_scales, strict=True
            )
            if free
        ),
        outlier_count=measured_count - int(fit.used.sum()),
        value_count=measured_count,
        error=_fit_error(problem, model, fit),
        chi2=fit.chi2,
        held_out=held_out,
        sensors=names,
        frequencies=frequencies,
        measured=problem.values / fit.scales,
        before=initial_responses(problem),
        after=gains[:, :, None] * responses,
    )
