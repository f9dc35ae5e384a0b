"""Maximum a posteriori fit of a rig's parameters, with the form errors of its plate.

    d_fes = g_fe s_s a_fes(x, t) + noise,    t ~ N(0, 1),  s ~ N(1, tolerance)

d measured, a of the model, g a complex gain of every frequency and ERA, s a real scale of every
sensor, t form errors (`model.calibration.form_errors`). Gains are projected out
(`model.calibration.variable_projection`); x, s and t are searched.

Noise has a constant part and a part in proportion to the response, both estimated from the
residuals. A first fit has no form errors and leaves outliers out, the worst of a row first, since
one pulls the gain of its row. What tolerances leave undetermined is part of the standard errors:
C = (J^T J)^-1 with the tolerances as rows of J, times chi² per degree of freedom where that is
above 1. With gains projected out of J this is the Schur complement, so that of a gain

    var g_fe = sigma_fe² + (dg_fe/dz) C (dg_fe/dz)^T

sigma of the noise, z all that is searched: scales that sensors have in common are part of it.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from model.arrays import ComplexArray, FloatArray
from model.calibration.form_errors import SENSOR_SCALE, FormModel
from model.calibration.sensed_plate import Parameters
from model.calibration.variable_projection import project_gains, projection_slopes, row_rms
from model.identification.least_squares import Loss, search
from model.rig.rig import Rig

_MAX_DEVIATION = 5.0  # standard deviations; of 10 000 good complex values 0.04 lie beyond
_PEAK = 3.0  # times the median of a row; twice that is rare on a plate
_ROUNDS = 8
_SETTLED = 0.1  # of the noise between two rounds
_LEAST_LEFT = 0.1  # of a value's noise: residuals with less tell nothing of it
_HOLD = 1e3  # by which a mean of scales is held
_SMALLEST_NOISE = 1e-4  # of the response: what meshes and reduction are wrong by


@dataclass(frozen=True, eq=False)
class Problem:
    """A rig with the model of its plate, and the measured values (f, e, s), NaN where none.

    free (n,), free_scales (s,): masks of the parameters to be fitted, and of the scales without a
    tolerance; has_form: whether form errors are fitted, or held at zero.
    """

    rig: Rig
    model: FormModel
    parameters: Parameters
    values: ComplexArray
    free: NDArray[np.bool_]
    free_scales: NDArray[np.bool_]
    has_form: bool = True

    def at(self, kept: NDArray[np.bool_]) -> "Problem":
        """Select some of the sensors (s,)."""
        return replace(
            self,
            model=self.model.at(kept),
            values=self.values[:, :, kept],
            free_scales=self.free_scales[kept],
        )

    @property
    def searched(self) -> NDArray[np.bool_]:
        """Mask of what is searched: free x, all scales, form errors."""
        scales = np.ones(len(self.free_scales), dtype=bool)
        return np.concatenate([self.free, scales, np.full(len(self.model.std), self.has_form)])

    def split(self, z: FloatArray) -> list[FloatArray]:
        """Parameters x, scales and form errors of z."""
        n = len(self.free)
        return np.split(z, [n, n + len(self.free_scales)])

    def responses(self, z: FloatArray) -> tuple[ComplexArray, ComplexArray]:
        """Responses (f, e, s) as sensors read them, and derivatives by what is searched of z."""
        x, scales, form = self.split(z)
        plain, by = self.model.responses(self.parameters, x, form, has_form=self.has_form)
        by_scale = plain[None] * np.eye(len(scales))[:, None, None, :]
        by_x, by_form = np.split(by * scales, [len(x)])
        return plain * scales, np.concatenate([by_x[self.free], by_scale, by_form])

    def tolerances(self, start: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Rows (m, z) that hold scales and form errors, in tolerances, and their targets (m,)."""
        n, s, t = len(self.free), len(self.free_scales), len(self.model.std)
        scales = np.where(self.free_scales, 0, 1 / SENSOR_SCALE)
        size = np.concatenate([np.zeros(n), scales, np.full(t, float(self.has_form))])
        rows = np.diag(size)[size > 0]
        targets = rows[:, n : n + s].sum(axis=1)
        if self.free_scales.all():
            # Gains determine a common scale; the mean is held.
            mean = np.zeros((1, len(start)))
            mean[0, n : n + s] = _HOLD / s
            rows, targets = np.vstack([rows, mean]), np.append(targets, mean @ start)
        return rows, targets


@dataclass(frozen=True, eq=False)
class Fit:
    """Result of a fit.

    x, x_error (n,); scales, scales_error (s,); gains, gains_error (f, e), NaN where unmeasured, the
    latter of magnitudes, phases_error (f, e) [rad]; form, form_error (t,): form errors in their
    tolerances; predicted (f, e, s): with gains and scales; noise (f, e): standard deviation of a
    value; used (f, e, s): mask of values without outliers; chi2: sum of squares per degree of
    freedom.
    """

    x: FloatArray
    x_error: FloatArray
    scales: FloatArray
    scales_error: FloatArray
    form: FloatArray
    form_error: FloatArray
    gains: ComplexArray
    gains_error: FloatArray
    phases_error: FloatArray
    predicted: ComplexArray
    noise: FloatArray
    used: NDArray[np.bool_]
    chi2: float

    def at(self, kept: NDArray[np.bool_], model: FormModel) -> "Fit":
        """Select some of the sensors (s,) as the start of another fit."""
        return replace(
            self,
            scales=self.scales[kept],
            used=self.used[:, :, kept],
            form=model.select(self.form, kept),
        )


@dataclass(frozen=True, eq=False)
class _Found:
    """Where a search ended: z, with the derivatives of the residuals by what is searched."""

    z: FloatArray
    jacobian: FloatArray
    residual: FloatArray


def first_fit(problem: Problem, x: FloatArray) -> Fit:
    """Fit from starting values x (n,), all scales free and no form errors, despite outliers."""
    scales = np.ones(len(problem.free_scales))
    problem = replace(problem, has_form=False, free_scales=scales > 0)
    z = np.concatenate([x, scales, np.zeros(len(problem.model.std))])
    used = np.isfinite(problem.values)
    # Without residuals to judge by, peaks of a row are clipped at first.
    clipped = replace(problem, values=_without_peaks(problem.values, used))
    noise = 0.05 * row_rms(clipped.values, used)
    found = _search(clipped, z, used / noise[:, :, None], loss="soft_l1")
    for number in range(_ROUNDS):
        raw = _deviation(problem, found.z, used / noise[:, :, None])
        noise = _noise_of(problem.values, raw, used)
        kept = _without_worst(raw / noise[:, :, None], used)
        is_settled = number > 0 and bool((kept == used).all())
        used = kept
        loss: Loss = "linear" if is_settled else "soft_l1"
        found = _search(problem, found.z, used / noise[:, :, None], loss=loss)
        if is_settled:
            break
    return _result(problem, found, noise, used)


def solve(problem: Problem, start: Fit) -> Fit:
    """Fit parameters, scales and form errors, from those of another fit."""
    z = np.concatenate([start.x, start.scales, start.form])
    noise, used = start.noise, start.used
    finite = np.isfinite(problem.values)
    for _ in range(_ROUNDS):
        weight = used / noise[:, :, None]
        found = _search(problem, z, weight)
        z, before = found.z, noise
        raw = _deviation(problem, z, weight)
        noise = _noise_of(problem.values, raw, used, _noise_left(problem, found, weight))
        # What form errors explain comes back.
        kept = finite & ~(raw > _MAX_DEVIATION * np.sqrt(2) * noise[:, :, None])
        is_settled = bool((kept == used).all() and (np.abs(noise / before - 1) < _SETTLED).all())
        used = kept
        if is_settled:
            break
    return _result(problem, _search(problem, z, used / noise[:, :, None]), noise, used)


def _search(
    problem: Problem, start: FloatArray, weight: FloatArray, *, loss: Loss = "linear"
) -> _Found:
    searched, inside = problem.searched, weight > 0
    tolerances, targets = problem.tolerances(start)

    def full(y: FloatArray) -> FloatArray:
        whole = start.copy()
        whole[searched] = y
        return whole

    def linearised(y: FloatArray) -> tuple[FloatArray, FloatArray]:
        z = full(y)
        model, by_z = problem.responses(z)
        _, left = project_gains(model, problem.values, weight)
        _, slopes = projection_slopes(model, by_z, problem.values, weight)
        data, rows = left[inside], slopes[:, inside].T
        return (
            np.concatenate([data.real, data.imag, tolerances @ z - targets]),
            np.vstack([rows.real, rows.imag, tolerances[:, searched]]),
        )

    bounds = np.full((2, len(start)), [[-np.inf], [np.inf]])
    bounds[:, : len(problem.free)] = problem.parameters.bounds
    found = search(linearised, start[searched], bounds[:, searched], loss=loss)
    return _Found(full(found.x), np.asarray(found.jac), np.asarray(found.fun))


def _deviation(problem: Problem, z: FloatArray, weight: FloatArray) -> FloatArray:
    """Magnitudes (f, e, s) of the residuals of all values, outliers included [1/s²]."""
    model, _ = problem.responses(z)
    gains, _ = project_gains(model, problem.values, weight)
    return np.abs(problem.values - np.nan_to_num(gains)[:, :, None] * model)


def _noise_left(problem: Problem, found: _Found, weight: FloatArray) -> FloatArray:
    """Share (f, e, s) of each value's noise that is left in its residual: 1 - its leverage.

    That is of its row's gain, and of all that is searched, for which tolerances leave less.
    """
    inside = weight > 0
    model, _ = problem.responses(found.z)
    by_gain = np.abs(weight * model) ** 2
    total = by_gain.sum(axis=2, keepdims=True)
    left = 1 - by_gain / np.where(total > 0, total, 1)
    size = np.linalg.norm(found.jacobian, axis=0)
    scaled = found.jacobian / np.where(size > 0, size, 1)
    rows, strength, _ = np.linalg.svd(scaled, full_matrices=False)
    leverage = (rows[:, strength > 1e-9 * strength[0]] ** 2).sum(axis=1)
    left[inside] -= leverage[: 2 * inside.sum()].reshape(2, -1).mean(axis=0)
    return np.asarray(left)


def _result(problem: Problem, found: _Found, noise: FloatArray, used: NDArray[np.bool_]) -> Fit:
    searched, weight = problem.searched, used / noise[:, :, None]
    rows = int(used.any(axis=2).sum())
    freedom = max(len(found.residual) - 2 * rows - int(searched.sum()), 1)
    chi2 = float((found.residual**2).sum()) / freedom
    size = np.linalg.norm(found.jacobian, axis=0)
    size[size == 0] = 1e-300
    _, strength, directions = np.linalg.svd(found.jacobian / size, full_matrices=False)
    seen = strength > 1e-9 * strength[0]
    blind = (np.abs(directions[~seen]) > 1e-6).any(axis=0)
    root = directions[seen].T / strength[seen] / size[:, None] * math.sqrt(max(chi2, 1.0))
    errors = np.zeros(len(found.z))
    errors[searched] = np.where(blind, np.inf, np.linalg.norm(root, axis=1))
    model, by_z = problem.responses(found.z)
    gains, _ = project_gains(model, problem.values, weight)
    by_gain, _ = projection_slopes(model, by_z, problem.values, weight)
    power = (np.abs(weight * model) ** 2).sum(axis=2)
    with np.errstate(divide="ignore", invalid="ignore"):
        relative = by_gain / gains
        of_noise = np.where(power > 0, max(chi2, 1.0) / (power * np.abs(gains) ** 2), np.nan)
    magnitude, phase = (
        np.sqrt(of_noise + (np.tensordot(root.T, part, axes=1) ** 2).sum(axis=0))
        for part in (relative.real, relative.imag)
    )
    x, scales, form = problem.split(found.z)
    x_error, scales_error, form_error = problem.split(errors)
    return Fit(
        x,
        x_error,
        scales,
        np.where(problem.free_scales, scales_error, 0.0),
        form,
        form_error,
        gains,
        np.abs(gains) * magnitude,
        phase,
        gains[:, :, None] * model,
        noise,
        used,
        chi2,
    )


def _without_peaks(values: ComplexArray, used: NDArray[np.bool_]) -> ComplexArray:
    """Values cut down to a few times the median magnitude of their row, their phases kept."""
    size = np.where(used, np.abs(values), np.nan)
    rows = used.any(axis=2)
    limit = np.full(size.shape[:2], np.inf)
    limit[rows] = _PEAK * np.nanmedian(size[rows], axis=1)
    return np.asarray(values * np.minimum(1, limit[:, :, None] / np.maximum(size, 1e-300)))


def _noise_of(
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


def _without_worst(deviation: FloatArray, used: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Take the worst value out of each row that has one beyond bounds and others to stay."""
    deviation = np.where(used, deviation / np.sqrt(2), 0)
    worst = deviation.argmax(axis=2)
    f, e = np.nonzero((deviation.max(axis=2) > _MAX_DEVIATION) & (used.sum(axis=2) > 2))
    kept = used.copy()
    kept[f, e, worst[f, e]] = False
    return kept
