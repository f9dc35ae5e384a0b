"""Nonlinear least squares for the parameters of a rig, gains and sensor scales.

    d_fes = g_fe s_s a_fes(x) + noise

d measured, a of the model, g a complex gain of every frequency and ERA, s a real scale of every
sensor. Gains are projected out (`model.calibration.variable_projection`); x and s are searched.
The standard errors include what the gains leave undetermined.

Noise has a constant part and a part in proportion to the response, both estimated from the
residuals. Outliers are left out, the worst of a row first, since one pulls the gain of its row.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares, nnls

from model.arrays import ComplexArray, FloatArray, IntArray
from model.calibration.parameters import Parameter, response_slopes, responses_at
from model.calibration.variable_projection import (
    modal_assurance,
    project_gains,
    projection_slopes,
    row_rms,
)
from model.rig.rig import Rig
from model.vibration.parametric_plate import ParametricPlate

_Loss: TypeAlias = Literal["linear", "soft_l1"]

MAX_DEVIATION = 5.0  # standard deviations; of 10 000 good complex values 0.04 lie beyond
_PEAK = 3.0  # times the median of a row; twice that is rare on a plate
_ROUNDS = 8
_LEAST_LEFT = 0.1  # of a value's noise: residuals with less tell nothing of it
_STEPS = 60  # of one search; a plate that fits takes ten
_HOLD = 1e3  # by which a mean of scales is held
_SMALLEST_NOISE = 1e-4  # of the response: what meshes and reduction are wrong by


@dataclass(frozen=True, eq=False)
class Problem:
    """A rig and the measured values (f, e, s), NaN where not measured.

    free (n,), free_scales (s,): masks of the parameters and sensor scales to be fitted.
    """

    rig: Rig
    plate: ParametricPlate
    parameters: tuple[Parameter, ...]
    values: ComplexArray
    free: NDArray[np.bool_]
    free_scales: NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Fit:
    """Result of a fit.

    x, x_error (n,); scales, scales_error (s,); gains, gains_error (f, e), NaN where unmeasured;
    noise (f, e): standard deviation of a value; used (f, e, s): mask of values without outliers;
    residual (f, e, s) in standard deviations.
    """

    x: FloatArray
    x_error: FloatArray
    scales: FloatArray
    scales_error: FloatArray
    gains: ComplexArray
    gains_error: FloatArray
    noise: FloatArray
    used: NDArray[np.bool_]
    residual: FloatArray


def solve(problem: Problem, x: FloatArray, scales: FloatArray) -> Fit:
    """Fit from starting values x (n,) and scales (s,), which those not free keep."""
    used = np.isfinite(problem.values)
    # Without residuals to judge by, peaks of a row are clipped at first.
    first = replace(problem, values=_without_peaks(problem.values, used))
    noise = 0.05 * row_rms(first.values, used)
    x, scales, _ = _search(first, x, scales, used / noise[:, :, None], loss="soft_l1")
    for number in range(_ROUNDS):
        left = _residual(problem, x, scales, used / noise[:, :, None])
        raw = np.abs(left) * noise[:, :, None]
        noise = noise_of(problem.values, raw, used)
        kept = _without_outliers(raw / noise[:, :, None], used)
        is_settled = number > 0 and bool((kept == used).all())
        used = kept
        weight = used / noise[:, :, None]
        loss: _Loss = "linear" if is_settled else "soft_l1"
        x, scales, errors = _search(problem, x, scales, weight, loss=loss)
        if is_settled:
            break
    model = _model(problem, x) * scales
    gains, residual = project_gains(model, problem.values, weight)
    power = (np.abs(weight * model) ** 2).sum(axis=2)
    with np.errstate(divide="ignore"):
        gains_error = np.where(power > 0, 1 / np.sqrt(power), np.nan)
    x_error = np.zeros(len(x))
    x_error[problem.free] = errors[: problem.free.sum()]
    scales_error = np.zeros(len(scales))
    scales_error[problem.free_scales] = errors[problem.free.sum() :]
    return Fit(x, x_error, scales, scales_error, gains, gains_error, noise, used, np.abs(residual))


def misfit(problem: Problem, x: FloatArray) -> float:
    """Median over rows of 1 - MAC, 0 to 1, for all parameters x (n,), free or not."""
    model = _model(problem, x)
    return float(np.nanmedian(1 - modal_assurance(problem.values, model)))


def _search(
    problem: Problem, x: FloatArray, scales: FloatArray, weight: FloatArray, *, loss: _Loss
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return x, scales, and standard errors of the free parameters and scales."""
    free, free_scales = problem.free, problem.free_scales
    count = int(free.sum())

    # Gains determine a common scale; the mean is held.
    is_mean_held = bool(free_scales.all())

    def unpack(z: FloatArray) -> tuple[FloatArray, FloatArray]:
        full, sensors = x.copy(), scales.copy()
        full[free], sensors[free_scales] = z[:count], z[count:]
        return full, sensors

    def residual(z: FloatArray) -> FloatArray:
        full, sensors = unpack(z)
        left = _residual(problem, full, sensors, weight)[weight > 0]
        parts = [left.real, left.imag]
        if is_mean_held:
            parts.append(_HOLD * (sensors.mean(keepdims=True) - scales.mean()))
        return np.concatenate(parts)

    def jacobian(z: FloatArray) -> FloatArray:
        full, sensors = unpack(z)
        plain, by_x = response_slopes(problem.plate, problem.rig, problem.parameters, full)
        by_scale = plain * np.eye(len(scales))[free_scales, None, None]
        slopes = np.concatenate([by_x[free] * sensors, by_scale])
        _, slopes = projection_slopes(plain * sensors, slopes, problem.values, weight)
        rows = slopes[:, weight > 0]
        parts = [rows.real, rows.imag]
        if is_mean_held:
            parts.append(np.repeat([[0.0], [_HOLD / len(scales)]], [count, len(scales)], axis=0))
        return np.concatenate(parts, axis=1).T

    start = np.concatenate([x[free], scales[free_scales]])
    if len(start) == 0:
        return x, scales, start
    lower, upper = _bounds(problem.parameters, free, len(start) - count)
    found = least_squares(
        residual,
        np.clip(start, lower + 1e-9, upper - 1e-9),
        jacobian,
        bounds=(lower, upper),
        loss=loss,
        x_scale="jac",
        max_nfev=_STEPS,
        xtol=1e-9,
        ftol=1e-9,
    )
    full, sensors = unpack(found.x)
    frequency = np.broadcast_to(np.arange(len(weight))[:, None, None], weight.shape)[weight > 0]
    rows = int((weight > 0).any(axis=2).sum())
    freedom = max(2 * int((weight > 0).sum()) - 2 * rows - len(start), 1)
    errors = _standard_errors(
        np.asarray(found.jac), found.fun, np.tile(frequency, 2), freedom=freedom
    )
    return full, sensors, errors


def _standard_errors(
    jacobian: FloatArray, residual: FloatArray, group: IntArray, *, freedom: int
) -> FloatArray:
    """Standard errors of the fitted (n,); infinite where undetermined.

    The larger of two: with all residuals (m,) independent, and with those of a frequency
    correlated, as they are where the model is wrong (sandwich estimate). group: frequency index of
    each residual, except of those at the end that have none.
    """
    size = np.linalg.norm(jacobian, axis=0)
    size[size == 0] = 1e-300
    _, strength, directions = np.linalg.svd(jacobian / size, full_matrices=False)
    seen = strength > 1e-9 * strength[0]
    blind = (np.abs(directions[~seen]) > 1e-6).any(axis=0)
    inverse = (directions[seen].T / strength[seen] ** 2) @ directions[seen]
    independent = np.diagonal(inverse) * (residual**2).sum() / freedom
    pull = (jacobian / size * residual[:, None])[: len(group)]
    pulls = np.zeros((int(group.max()) + 1, len(size)))
    np.add.at(pulls, group, pull)
    grouped = ((pulls @ inverse) ** 2).sum(axis=0)
    return np.where(blind, np.inf, np.sqrt(np.maximum(independent, grouped)) / size)


def _bounds(
    parameters: Sequence[Parameter], free: NDArray[np.bool_], scales: int
) -> tuple[FloatArray, FloatArray]:
    fitted = [parameter for parameter, is_free in zip(parameters, free, strict=True) if is_free]
    lower = [parameter.lower for parameter in fitted] + [-100.0] * scales
    upper = [parameter.upper for parameter in fitted] + [100.0] * scales
    return np.array(lower), np.array(upper)


def _residual(
    problem: Problem, x: FloatArray, scales: FloatArray, weight: FloatArray
) -> ComplexArray:
    """Weighted residual (f, e, s) with the best gains; zero where nothing was measured."""
    return project_gains(_model(problem, x) * scales, problem.values, weight)[1]


def _model(problem: Problem, x: FloatArray) -> ComplexArray:
    return responses_at(problem.plate, problem.rig, problem.parameters, x)


def _without_peaks(values: ComplexArray, used: NDArray[np.bool_]) -> ComplexArray:
    """Values cut down to a few times the median magnitude of their row, their phases kept."""
    size = np.where(used, np.abs(values), np.nan)
    rows = used.any(axis=2)
    limit = np.full(size.shape[:2], np.inf)
    limit[rows] = _PEAK * np.nanmedian(size[rows], axis=1)
    return np.asarray(values * np.minimum(1, limit[:, :, None] / np.maximum(size, 1e-300)))


def noise_of(
    values: ComplexArray,
    raw: FloatArray,
    used: NDArray[np.bool_],
    left: FloatArray | None = None,
) -> FloatArray:
    """Standard deviation (f, e) of a value's real or imaginary part: sqrt(a² + b² size²).

    From the medians of residuals raw (f, e, s), over rows from weak to strong. left (f, e, s):
    share of noise power that a fit leaves in them; by default all but what a gain takes of its row.
    """
    size = row_rms(values, used)
    sensors = used.sum(axis=2)
    rows = np.flatnonzero((sensors >= 2).ravel())
    floor = _SMALLEST_NOISE * size
    if len(rows) < 4:
        return floor
    if left is None:
        # A gain takes one of the row's values with it.
        left = np.broadcast_to((1 - 1 / np.maximum(sensors, 2))[:, :, None], raw.shape)
    telling = used & (left > _LEAST_LEFT)
    power = np.full(raw.shape, np.nan)
    power[telling] = raw[telling] ** 2 / left[telling] / 2
    power = power.reshape(-1, used.shape[2])[rows]
    order = np.argsort(size.ravel()[rows], kind="stable")
    found, at = [], []
    for group in np.array_split(order, min(12, len(rows) // 2)):
        # The median of |z|² of complex noise with variance 2 is 2 log 2.
        found.append(np.nanmedian(power[group]) / np.log(2))
        at.append(np.median(size.ravel()[rows][group] ** 2))
    scale = np.maximum(found, 1e-12 * np.array(at))
    matrix = np.column_stack([1 / scale, np.array(at) / scale])
    weight = np.linalg.norm(matrix, axis=0)
    a2, b2 = nnls(matrix / weight, np.ones(len(scale)))[0] / weight
    return np.asarray(np.sqrt(a2 + b2 * size**2 + floor**2))


def _without_outliers(deviation: FloatArray, used: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Take the worst value out of each row that has one beyond bounds and others to stay."""
    deviation = np.where(used, deviation / np.sqrt(2), 0)
    worst = deviation.argmax(axis=2)
    f, e = np.nonzero((deviation.max(axis=2) > MAX_DEVIATION) & (used.sum(axis=2) > 2))
    kept = used.copy()
    kept[f, e, worst[f, e]] = False
    return kept
