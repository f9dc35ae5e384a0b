"""Calibration of a rig by measured responses, without dead channels and outliers."""

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from model.arrays import ComplexArray, FloatArray
from model.calibration.calibration_result import (
    MAX_FIT_ERROR,
    Calibration,
    FittedParameter,
    HeldOut,
    SensorScale,
)
from model.calibration.calibration_screening import sensors_off_model, silent_eras, silent_sensors
from model.calibration.fit import Fit, Problem, misfit, solve
from model.calibration.held_out import hold_out, initial_responses, relative_error
from model.calibration.parameters import Parameter, parameters_of, rig_with, starts
from model.calibration.responses import Responses
from model.calibration.variable_projection import row_rms
from model.errors import InputError
from model.rig.rig import Rig
from model.structure.actuator import Gain
from model.vibration.parametric_plate import ParametricPlate, parametric_plate

_STARTS = 2  # those with the least misfit of shapes
_WRONG_SCALE = 0.02  # common tolerance of sensors
_SIGNIFICANCE = 4.0  # standard errors
_LEAST_SENSORS = 3

# Relative error of values by idealisations of the model: viscous instead of hysteretic damping
# changes the loss factor by 0.15 %, other values by less.
_MODEL_ERROR = 2e-3


def calibrate(rig: Rig, responses: Responses, *, all_scales: bool = False) -> Calibration:
    """Fit a rig to responses measured on it.

    all_scales: estimate the scale of every sensor, not only of wrong ones. Raises InputError if
    fewer than three sensors have a signal or nothing was driven.
    """
    alive, dead_eras = ~silent_sensors(responses), silent_eras(responses)
    values = responses.values.copy()
    values[:, dead_eras] = np.nan
    _check_enough(alive, responses)
    plate = parametric_plate(rig, responses.points, responses.frequencies)
    parameters = parameters_of(rig)

    # All scales are free at first, so that a wrong one does not bias the fit.
    problem = _problem(rig, plate, parameters, values, alive)
    fit = _best_fit(problem)
    relative = fit.scales / np.median(fit.scales)
    unlike = sensors_off_model(problem, fit, relative)
    if unlike.any():
        alive[alive] = ~unlike
        _check_enough(alive, responses)
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
    problem, fit = _identified(problem, solve(problem, fit.x, relative))
    if all_scales:
        fit = _with_median_scale_one(fit)
    names = tuple(name for name, live in zip(responses.sensors, alive, strict=True) if live)
    return _report(
        problem,
        fit,
        names=names,
        frequencies=responses.frequencies,
        dead_sensors=tuple(
            name for name, live in zip(responses.sensors, alive, strict=True) if not live
        ),
        dead_eras=tuple(era.name for era, dead in zip(rig.eras, dead_eras, strict=True) if dead),
        held_out=hold_out(problem, fit, names),
    )


def _check_enough(alive: NDArray[np.bool_], responses: Responses) -> None:
    if alive.sum() < _LEAST_SENSORS:
        dead = [n for n, live in zip(responses.sensors, alive, strict=True) if not live]
        without = f" ({', '.join(dead)} without a signal)" if dead else ""
        raise InputError(
            f"at least {_LEAST_SENSORS} sensors must have a signal, better eight or more, got "
            f"{alive.sum()}{without}"
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
    best_starts = sorted(starts(problem.parameters), key=lambda x: misfit(problem, x))[:_STARTS]
    ones = np.ones(problem.values.shape[2])
    fits = [solve(problem, start, ones) for start in best_starts]
    return min(fits, key=lambda fit: misfit(problem, fit.x))


def _identified(problem: Problem, fit: Fit) -> tuple[Problem, Fit]:
    """Hold parameters that the data determine less than their prior does, and fit again."""
    prior = np.array([parameter.prior_std for parameter in problem.parameters])
    own = np.array([parameter.start for parameter in problem.parameters])
    while True:
        excess = np.where(problem.free, fit.x_error / prior, 0)
        # Values of a plate that does not fit are meaningless.
        if not excess.max() > 1 or _fit_error(problem, fit) > MAX_FIT_ERROR:
            return problem, fit
        free = problem.free.copy()
        free[int(excess.argmax())] = False
        problem = replace(problem, free=free)
        fit = solve(problem, np.where(free, fit.x, own), fit.scales)


def _fit_error(problem: Problem, fit: Fit) -> float:
    rig = rig_with(problem.rig, problem.parameters, fit.x)
    predicted = fit.gains[:, :, None] * problem.plate.responses(rig) * fit.scales
    return relative_error(problem.values, predicted, row_rms(problem.values, fit.used), fit.used)


def _with_median_scale_one(fit: Fit) -> Fit:
    middle = float(np.median(fit.scales))
    return replace(
        fit,
        scales=fit.scales / middle,
        scales_error=fit.scales_error / abs(middle),
        gains=fit.gains * middle,
        gains_error=fit.gains_error * abs(middle),
    )


def _report(
    problem: Problem,
    fit: Fit,
    *,
    names: tuple[str, ...],
    frequencies: FloatArray,
    dead_sensors: tuple[str, ...],
    dead_eras: tuple[str, ...],
    held_out: HeldOut | None,
) -> Calibration:
    rig = rig_with(problem.rig, problem.parameters, fit.x)
    model = problem.plate.responses(rig)
    after = fit.gains[:, :, None] * model
    eras = tuple(
        replace(era, gains=_gain_rows(fit.gains[:, number], frequencies) or era.gains)
        for number, era in enumerate(rig.eras)
    )
    parameters = tuple(
        FittedParameter(
            parameter,
            parameter.value(float(x)),
            _with_model_error(parameter, float(x), float(error)) if free else None,
            bool(free and min(x - parameter.lower, parameter.upper - x) < 1e-6),
        )
        for parameter, x, error, free in zip(
            problem.parameters, fit.x, fit.x_error, problem.free, strict=True
        )
    )
    measured_count = int(np.isfinite(problem.values).sum())
    return Calibration(
        rig=replace(rig, eras=eras),
        parameters=parameters,
        gains_error=fit.gains_error,
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
        error=_fit_error(problem, fit),
        held_out=held_out,
        sensors=names,
        frequencies=frequencies,
        measured=problem.values / fit.scales,
        before=initial_responses(problem),
        after=after,
    )


def _with_model_error(parameter: Parameter, x: float, error: float) -> float:
    return math.hypot(parameter.standard_error(x, error), _MODEL_ERROR * parameter.value(x))


def _gain_rows(gains: ComplexArray, frequencies: FloatArray) -> tuple[Gain, ...]:
    known = np.isfinite(gains) & (gains != 0)
    return tuple(
        (float(f), float(abs(gain)), float(np.angle(gain)))
        for f, gain in zip(frequencies[known], gains[known], strict=True)
    )
