"""Validation of a fit at sensors held out of it."""

from dataclasses import replace
from itertools import compress

import numpy as np
from numpy.typing import NDArray

from model.arrays import ComplexArray, FloatArray
from model.calibration.calibration_result import HeldOutSensors
from model.calibration.fit import CalibrationProblem, Fit, solve
from model.calibration.fitted_rig import predicted_by, rig_of_fit
from model.calibration.responses import Responses
from model.calibration.variable_projection import row_rms
from model.identification.held_out import SHARE, relative_rms


def hold_out(problem: CalibrationProblem, fit: Fit, live: Responses) -> HeldOutSensors | None:
    """Fit without some of the live sensors of known scale, and predict their responses.

    Predicted by the rig as its file has it, without other form errors.
    """
    count = len(live.sensors)
    candidates = np.flatnonzero(~problem.free_scales | problem.free_scales.all())
    wanted = round(count / SHARE)
    if count < SHARE or len(candidates) <= wanted:
        return None
    evenly_spaced = np.linspace(0, len(candidates) - 1, wanted + 2)[1:-1].round().astype(int)
    unseen = np.zeros(count, dtype=bool)
    unseen[candidates[evenly_spaced]] = True
    part = problem.without(unseen)
    seen = solve(part, fit)
    rig, scales = rig_of_fit(part, seen), problem.scales(fit.z)
    responses, gains = predicted_by(
        rig, problem, live.points, replace(fit, used=fit.used & ~unseen)
    )
    predicted = gains[:, :, None] * responses * scales
    size = row_rms(problem.values)
    which = fit.used & unseen
    return HeldOutSensors(
        tuple(compress(live.sensors, unseen)),
        relative_error(
            problem.values, initial_responses(problem) * scales, size, unseen[None, None]
        ),
        relative_error(problem.values, predicted, size, which),
        float(np.median((np.abs(predicted - problem.values) / size[:, :, None])[which])),
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
