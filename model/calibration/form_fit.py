"""Maximum a posteriori fit of a rig's parameters together with its form errors.

    d_fes = g_fe s_s a_fes(x, t) + noise,    t ~ N(0, 1),  s ~ N(1, tolerance)

as `model.calibration.fit`, from which it starts, with form errors t and the scales of good sensors
held by their tolerances (`model.calibration.form_errors`). What they leave undetermined is then
part of the standard errors: C = (J^T J)^-1 with the tolerances as rows of J, times chi² per degree
of freedom where that is above 1. With gains projected out of J this is the Schur complement, so
that of a gain

    var g_fe = sigma_fe² + (dg_fe/dz) C (dg_fe/dz)^T

sigma of the noise, z all that is searched: scales that sensors have in common are part of it.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from model.arrays import ComplexArray, FloatArray
from model.calibration.fit import MAX_DEVIATION, Fit, Problem, noise_of
from model.calibration.form_errors import SENSOR_SCALE, FormModel
from model.calibration.variable_projection import project_gains

_ROUNDS = 8
_STEPS = 50
_SETTLED = 0.1  # of the noise between two rounds


@dataclass(frozen=True, eq=False)
class FormFit(Fit):
    """Result of the fit: as `Fit`, with form errors (t,) in their tolerances and chi².

    phases_error (f, e) [rad]: as gains_error, which is of magnitudes; covariance (n, n): of all x,
    zero for those held; chi2: sum of squares per degree of freedom, before scaling.
    """

    phases_error: FloatArray
    form: FloatArray
    form_error: FloatArray
    covariance: FloatArray
    chi2: float

    def at(self, kept: NDArray[np.bool_], model: FormModel) -> "FormFit":
        """Select some of the sensors (s,) as the start of another fit."""
        form = model.select(self.form, kept)
        return replace(
            self,
            scales=self.scales[kept],
            scales_error=self.scales_error[kept],
            used=self.used[:, :, kept],
            residual=self.residual[:, :, kept],
            form=form,
            form_error=model.select(self.form_error, kept),
        )


def solve_with_form(problem: Problem, model: FormModel, start: Fit) -> FormFit:
    """Fit parameters, scales and form errors, from those of another fit.

    Scales that are free in the problem have no prior.
    """
    form = start.form if isinstance(start, FormFit) else np.zeros(len(model.std))
    z = np.concatenate([start.x, start.scales, form])
    noise, used = start.noise, start.used
    finite = np.isfinite(problem.values)
    for _ in range(_ROUNDS):
        weight = used / noise[:, :, None]
        z, jacobian, _ = _search(problem, model, z, weight)
        raw = _deviation(problem, model, z, weight)
        before = noise
        left = _noise_left(problem, model, z, weight, jacobian)
        noise = noise_of(problem.values, raw, used, left)
        # What form errors explain comes back.
        kept = finite & ~(raw > MAX_DEVIATION * np.sqrt(2) * noise[:, :, None])
        is_settled = bool((kept == used).all() and (np.abs(noise / before - 1) < _SETTLED).all())
        used = kept
        if is_settled:
            break
    weight = used / noise[:, :, None]
    z, jacobian, residual = _search(problem, model, z, weight)
    return _result(problem, model, z, weight, jacobian, residual, noise, used)


def _deviation(problem: Problem, model: FormModel, z: FloatArray, weight: FloatArray) -> FloatArray:
    """Magnitudes (f, e, s) of the residuals of all values, outliers included [1/s²]."""
    n, s = len(problem.parameters), len(problem.free_scales)
    plain, _ = model.responses(problem.parameters, z[:n], z[n + s :])
    whole = plain * z[n : n + s]
    gains, _ = project_gains(whole, problem.values, weight)
    return np.abs(problem.values - np.nan_to_num(gains)[:, :, None] * whole)


def _noise_left(
    problem: Problem, model: FormModel, z: FloatArray, weight: FloatArray, jacobian: FloatArray
) -> FloatArray:
    """Share (f, e, s) of each value's noise that is left in its residual: 1 - its leverage.

    That is of its row's gain, and of all that is searched, for which tolerances leave less.
    """
    n, s = len(problem.parameters), len(problem.free_scales)
    inside = weight > 0
    plain, _ = model.responses(problem.parameters, z[:n], z[n + s :])
    by_gain = np.abs(weight * plain * z[n : n + s]) ** 2
    total = by_gain.sum(axis=2, keepdims=True)
    left = 1 - by_gain / np.where(total > 0, total, 1)
    size = np.linalg.norm(jacobian, axis=0)
    rows, strength, _ = np.linalg.svd(jacobian / np.where(size > 0, size, 1), full_matrices=False)
    leverage = (rows[:, strength > 1e-9 * strength[0]] ** 2).sum(axis=1)
    left[inside] -= leverage[: 2 * inside.sum()].reshape(2, -1).mean(axis=0)
    return np.asarray(left)


def _free(problem: Problem, model: FormModel) -> NDArray[np.bool_]:
    """Mask of the searched values: free x, all scales, all form errors."""
    others = np.ones(len(problem.free_scales) + len(model.std), dtype=bool)
    return np.concatenate([problem.free, others])


def _search(
    problem: Problem, model: FormModel, z: FloatArray, weight: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    free = _free(problem, model)
    inside = weight > 0
    n, s = len(problem.parameters), len(problem.free_scales)
    held = np.concatenate([~problem.free_scales, np.ones(len(model.std), dtype=bool)])
    prior_std = np.concatenate([np.full(s, SENSOR_SCALE), np.ones(len(model.std))])
    center = np.concatenate([np.ones(s), np.zeros(len(model.std))])

    def full(y: FloatArray) -> FloatArray:
        whole = z.copy()
        whole[free] = y
        return whole

    cache: dict[bytes, tuple[FloatArray, FloatArray]] = {}

    def both(y: FloatArray) -> tuple[FloatArray, FloatArray]:
        key = y.tobytes()
        if key not in cache:
            cache.clear()
            whole = full(y)
            derivative, left = _residual(problem, model, whole, weight)
            prior = ((whole[n:] - center) / prior_std)[held]
            rows = np.diag(1 / prior_std)[held]
            rows = np.hstack([np.zeros((len(rows), n)), rows])
            data = derivative[:, inside]
            jacobian = np.vstack([data.real.T, data.imag.T, rows])[:, free]
            residual = np.concatenate([left[inside].real, left[inside].imag, prior])
            if problem.free_scales.all():
                # Gains determine a common scale; the mean is held.
                mean = np.zeros(len(z))
                mean[n : n + s] = 1e3 / s
                jacobian = np.vstack([jacobian, mean[free]])
                residual = np.append(
                    residual, 1e3 * (whole[n : n + s].mean() - z[n : n + s].mean())
                )
            cache[key] = residual, jacobian
        return cache[key]

    lower = np.full(len(z), -np.inf)
    upper = np.full(len(z), np.inf)
    lower[:n] = [p.lower for p in problem.parameters]
    upper[:n] = [p.upper for p in problem.parameters]

    def values(y: FloatArray) -> FloatArray:
        return both(y)[0]

    def derivatives(y: FloatArray) -> FloatArray:
        return both(y)[1]

    found = least_squares(
        values,
        np.clip(z, lower + 1e-9, upper - 1e-9)[free],
        derivatives,
        bounds=(lower[free], upper[free]),
        x_scale="jac",
        max_nfev=_STEPS,
        xtol=1e-7,
        ftol=1e-8,
    )
    return full(found.x), np.asarray(found.jac), np.asarray(found.fun)


def _residual(
    problem: Problem, model: FormModel, z: FloatArray, weight: FloatArray
) -> tuple[ComplexArray, ComplexArray]:
    """Derivatives (n + s + t, f, e, s) of the weighted residual, and the residual (f, e, s).

    Gains are projected out; the derivative is that of Kaufman (BIT 15, 1975), exact for a residual
    of zero.
    """
    n, s = len(problem.parameters), len(problem.free_scales)
    x, scales, form = np.split(z, [n, n + s])
    plain, by = model.responses(problem.parameters, x, form)
    whole = plain * scales
    gains, left = project_gains(whole, problem.values, weight)
    by_scale = plain[None] * np.eye(s)[:, None, None, :]
    changes = np.concatenate([by[:n] * scales, by_scale, by[n:] * scales])
    changes *= weight
    unit = weight * whole
    power = (np.abs(unit) ** 2).sum(axis=-1, keepdims=True)
    unit = unit / np.sqrt(np.where(power > 0, power, 1))
    changes -= unit * (unit.conj() * changes).sum(axis=-1, keepdims=True)
    return -np.nan_to_num(gains)[..., None] * changes, left


def _result(
    problem: Problem,
    model: FormModel,
    z: FloatArray,
    weight: FloatArray,
    jacobian: FloatArray,
    residual: FloatArray,
    noise: FloatArray,
    used: NDArray[np.bool_],
) -> FormFit:
    n, s = len(problem.parameters), len(problem.free_scales)
    free = _free(problem, model)
    x, scales, form = np.split(z, [n, n + s])
    rows = int((weight > 0).any(axis=2).sum())
    freedom = max(len(residual) - 2 * rows - int(free.sum()), 1)
    chi2 = float((residual**2).sum()) / freedom
    size = np.linalg.norm(jacobian, axis=0)
    size[size == 0] = 1e-300
    _, strength, directions = np.linalg.svd(jacobian / size, full_matrices=False)
    seen = strength > 1e-9 * strength[0]
    blind = (np.abs(directions[~seen]) > 1e-6).any(axis=0)
    root = directions[seen].T / strength[seen] / size[:, None] * math.sqrt(max(chi2, 1.0))
    inner = root @ root.T
    covariance = np.zeros((len(z), len(z)))
    covariance[np.ix_(free, free)] = inner
    errors = np.zeros(len(z))
    errors[free] = np.where(blind, np.inf, np.sqrt(np.diagonal(inner)))
    plain, by = model.responses(problem.parameters, x, form)
    whole = plain * scales
    gains, left = project_gains(whole, problem.values, weight)
    by_scale = plain[None] * np.eye(s)[:, None, None, :]
    by_all = np.concatenate([by[:n] * scales, by_scale, by[n:] * scales])[free]
    power = (np.abs(weight * whole) ** 2).sum(axis=2)
    with np.errstate(divide="ignore", invalid="ignore"):
        by_all = -(weight**2 * whole.conj() * by_all).sum(axis=3) / power  # relative, (z, f, e)
        of_noise = np.where(power > 0, max(chi2, 1.0) / (power * np.abs(gains) ** 2), np.nan)
    magnitude, phase = (
        np.sqrt(
            of_noise
            + ((root.T @ part.reshape(len(root), -1)) ** 2).sum(axis=0).reshape(power.shape)
        )
        for part in (by_all.real, by_all.imag)
    )
    return FormFit(
        x,
        errors[:n],
        scales,
        np.where(problem.free_scales, errors[n : n + s], 0.0),
        gains,
        np.abs(gains) * magnitude,
        noise,
        used,
        np.abs(left),
        phase,
        form,
        errors[n + s :],
        covariance[:n, :n],
        chi2,
    )
