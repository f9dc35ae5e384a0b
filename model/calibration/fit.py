"""Maximum a posteriori fit of a rig's parameters, with the form errors of its plate.

    d_fes = g_fe a_fes(z) + noise

d measured, a of the model as sensors of some scales read it, g a complex gain of every frequency
and ERA. Gains are projected out (`model.calibration.variable_projection`); z is searched: the
rig's values, which no prior holds, scales of sensors, form errors and what data sheets know better,
which tolerances hold.

Noise has a constant part and a part in proportion to the response, both estimated from the
residuals. What a check's plate leaves shows the outliers, the worst of a row first, since one pulls
the gain of its row. What tolerances leave undetermined is part of the standard errors:
C = (J^T J)^-1 with the tolerances as rows of J, times chi² per degree of freedom where that is
above 1. With gains projected out of J this is the Schur complement, so that of a gain

    var g_fe = sigma_fe² + (dg_fe/dz) C (dg_fe/dz)^T

sigma of the noise: scales that sensors have in common are part of it.
"""

import math
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from model.arrays import ComplexArray, FloatArray
from model.calibration.sensed_plate import SensedPlate
from model.calibration.variable_projection import (
    fit_with_gains,
    project_gains,
    projection_slopes,
    responses_of,
    row_rms,
)
from model.identification.least_squares import Minimum
from model.identification.parameters import FORM
from model.identification.viscous_loss import viscous_difference

_MAX_DEVIATION = 5.0  # standard deviations; of 10 000 good complex values 0.04 lie beyond
_ROUNDS = 8
_SETTLED = 0.1  # of the noise between two rounds
_LEAST_LEFT = 0.1  # of a value's noise: residuals with less tell nothing of it
_CLEAR = 3.0  # standard errors
_HOLD = 1e3  # by which a mean of scales is held
_SMALLEST_NOISE = 1e-4  # of the response: what meshes and reduction are wrong by


@dataclass(frozen=True, eq=False)
class CalibrationProblem:
    """The plate of a rig with its form errors, and the measured values (f, e, s), NaN where none.

    searched (p,), free_scales (s,): masks of the parameters to be fitted, and of the scales without
    a tolerance.
    """

    plate: SensedPlate
    values: ComplexArray
    searched: NDArray[np.bool_]
    free_scales: NDArray[np.bool_]

    @classmethod
    def of(cls, plate: SensedPlate, values: ComplexArray) -> Self:
        """Search everything but the gains of channels, with scales that no tolerance holds."""
        space = plate.model.space
        searched = space.uncertain & ~space.of("gain")
        return cls(plate, values, searched, np.ones(values.shape[2], dtype=bool))

    def without(self, sensors: NDArray[np.bool_]) -> Self:
        """The same where some sensors (s,) measured nothing; what is theirs stays as it starts."""
        groups, searched = self.plate.model.space.groups, self.searched.copy()
        searched[groups["sensor_scale"]] &= ~sensors
        searched[groups["sensor_place"]] &= np.repeat(~sensors, 2)
        values = np.where(sensors, np.nan, self.values)
        return replace(self, values=values, searched=searched)

    def with_law_at(self, z: FloatArray) -> Self:
        """The same where losses may be viscous, as at z (p,): that changes little with z."""
        model = self.plate.model
        model = replace(model, law=viscous_difference(replace(model, law=None), z))
        return replace(self, plate=replace(self.plate, model=model))

    @property
    def free(self) -> NDArray[np.bool_]:
        """Mask of the rig's values that are searched (n,)."""
        return self.searched[self.plate.numbers]

    def scales(self, z: FloatArray) -> FloatArray:
        """Scales of sensors (s,) of parameters z (p,)."""
        return 1 + self.plate.model.space.values(z, "sensor_scale")

    def scale_errors(self, fit: "Fit") -> FloatArray:
        """Standard errors of the scales that no tolerance holds (s,), 0 of others."""
        return self.free_scales * self.plate.model.space.values(fit.error, "sensor_scale")

    def at_scales(self, z: FloatArray, scales: FloatArray) -> FloatArray:
        """Parameters z (p,) with other scales of sensors (s,)."""
        space, found = self.plate.model.space, z.copy()
        own = space.groups["sensor_scale"]
        found[own] = (scales - 1) / space.std[own]
        return found

    def tolerances(self, start: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Rows (m, n) that hold what is searched of scales and form errors; their targets (m,)."""
        space, held = self.plate.model.space, self.searched.copy()
        held[self.plate.numbers] = self.free & self.plate.held
        held[space.groups["sensor_scale"]] &= ~self.free_scales
        rows, targets = np.eye(space.size)[held], np.zeros(held.sum())
        if self.free_scales.all():
            # Gains determine a common scale; the mean is held.
            mean = np.zeros((1, space.size))
            own = space.groups["sensor_scale"]
            mean[0, own] = _HOLD * (space.std * self.searched)[own] / len(self.free_scales)
            rows, targets = np.vstack([rows, mean]), np.append(targets, mean @ start)
        return rows[:, self.searched], targets


@dataclass(frozen=True, eq=False)
class FitStart:
    """Where a fit begins.

    z (p,): parameters; noise (f, e): standard deviation of a value; used (f, e, s): mask of values
    without outliers.
    """

    z: FloatArray
    noise: FloatArray
    used: NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Fit(FitStart):
    """Result of a fit.

    error (p,): standard errors of the parameters; gains, gains_error (f, e), NaN where unmeasured,
    the latter of magnitudes; readings_error (2, f, e): of magnitudes, relative, and phases [rad] of
    fields by what reads them alone, beside common_error, relative, of the magnitudes of all;
    predicted (f, e, s): with gains and scales; chi2: sum of squares per degree of freedom; dampers:
    what those of all ERAs do to the responses, relative to the plate's own losses.
    """

    error: FloatArray
    gains: ComplexArray
    gains_error: FloatArray
    readings_error: FloatArray
    common_error: float
    predicted: ComplexArray
    chi2: float
    dampers: float


def start_at(problem: CalibrationProblem, z: FloatArray) -> FitStart:
    """Scales of sensors, outliers and noise by the plate at z (p,)."""
    scales, noise, used = without_outliers(problem.values, problem.plate.responses(z))
    return FitStart(problem.at_scales(z, scales), noise, used)


def without_outliers(
    values: ComplexArray, model: ComplexArray
) -> tuple[FloatArray, FloatArray, NDArray[np.bool_]]:
    """Scales of sensors (s,), noise (f, e) and the mask (f, e, s) of values without outliers.

    values, model (f, e, s): measured, and by a plate, up to a gain of each frequency and ERA.
    """
    used, scales = np.isfinite(values), np.ones(values.shape[2])
    heard = used.any(axis=(0, 1))
    for _ in range(_ROUNDS):
        weight = used / row_rms(values, used)[:, :, None]
        gains, _ = project_gains(scales * model, values, weight)
        predicted = np.nan_to_num(gains)[:, :, None] * model
        share = np.divide(values, predicted, out=np.full_like(values, np.nan), where=used)
        scales[heard] = np.nanmedian(share.real[:, :, heard], axis=(0, 1))
        scales = scales / np.median(scales)
        raw = np.abs(values - scales * predicted)
        noise = _noise_of(values, raw, used)
        kept = _without_worst(raw / noise[:, :, None], used)
        if (kept == used).all():
            break
        used, heard = kept, kept.any(axis=(0, 1))
    return scales, noise, used


def solve(problem: CalibrationProblem, start: FitStart) -> Fit:
    """Fit parameters, scales and form errors."""
    finite = np.isfinite(problem.values)
    z, noise, used = start.z, start.noise, start.used & finite
    for _ in range(_ROUNDS):
        problem = problem.with_law_at(z)
        weight, before = used / noise[:, :, None], noise
        found = _search(problem, z, weight)
        z = found.x
        model = problem.plate.responses(z)
        gains, _ = project_gains(model, problem.values, weight)
        raw = np.abs(problem.values - np.nan_to_num(gains)[:, :, None] * model)
        noise = _noise_of(problem.values, raw, used, _noise_left(model, found, weight))
        # What form errors explain comes back.
        kept = finite & ~(raw > _MAX_DEVIATION * np.sqrt(2) * noise[:, :, None])
        is_settled = bool((kept == used).all() and (np.abs(noise / before - 1) < _SETTLED).all())
        used = kept
        if is_settled:
            break
    return _result(problem, _search(problem, z, used / noise[:, :, None]), noise, used)


def clear(fit: Fit) -> NDArray[np.bool_]:
    """Which parameters (p,) are off by several standard errors."""
    return np.asarray(np.abs(fit.z) > _CLEAR * fit.error)


def without_form(problem: CalibrationProblem, fit: Fit) -> tuple[FloatArray, FloatArray]:
    """Parameters z (p,) of the plate without form errors that explains best what was measured.

    And standard errors (p,) of what was searched, for which form errors are noise. ERAs stay where
    they clearly are. A rig cannot have form errors, which its field would lack; what they are like
    of modulus and loss factor comes back, as a side is like another modulus.
    """
    space, z = problem.plate.model.space, fit.z.copy()
    mine = space.of("modulus", "loss_added", "sensor_scale", "sensor_place")
    form = space.of(*FORM, "mode_shifts") & ~mine
    z[form | (space.of("place") & ~clear(fit))] = 0.0
    part = replace(problem, searched=problem.searched & mine)
    found = _search(part, z, fit.used / fit.noise[:, :, None])
    return found.x, _errors(part, found, fit.used)[0]


def _search(problem: CalibrationProblem, start: FloatArray, weight: FloatArray) -> Minimum:
    return fit_with_gains(
        problem.plate.model,
        problem.values,
        weight,
        start,
        problem.searched,
        prior=problem.tolerances(start),
    )


def _noise_left(model: ComplexArray, found: Minimum, weight: FloatArray) -> FloatArray:
    """Share (f, e, s) of each value's noise that is left in its residual: 1 - its leverage.

    That is of its row's gain, and of all that is searched, for which tolerances leave less.
    """
    inside = weight > 0
    by_gain = np.abs(weight * model) ** 2
    total = by_gain.sum(axis=2, keepdims=True)
    left = 1 - by_gain / np.where(total > 0, total, 1)
    leverage = (_directions(found)[0] ** 2).sum(axis=1)
    left[inside] -= leverage[: 2 * inside.sum()].reshape(2, -1).mean(axis=0)
    return np.asarray(left)


def _directions(found: Minimum) -> tuple[FloatArray, FloatArray, NDArray[np.bool_]]:
    """Singular vectors (m, k) of the derivatives, and what each moves by one standard error (n, k).

    Then a mask (n,) of what none of them determines.
    """
    size = np.linalg.norm(found.jacobian, axis=0)
    size[size == 0] = 1e-300
    rows, strength, columns = np.linalg.svd(found.jacobian / size, full_matrices=False)
    seen = strength > 1e-9 * strength[0]
    blind = (np.abs(columns[~seen]) > 1e-6).any(axis=0)
    return rows[:, seen], columns[seen].T / strength[seen] / size[:, None], blind


def _result(
    problem: CalibrationProblem, found: Minimum, noise: FloatArray, used: NDArray[np.bool_]
) -> Fit:
    z, searched, weight = found.x, problem.searched, used / noise[:, :, None]
    error, root, chi2 = _errors(problem, found, used)
    model, by_z = responses_of(problem.plate.model, z, searched)
    gains, _ = project_gains(model, problem.values, weight)
    by_gain, _ = projection_slopes(model, by_z, problem.values, weight)
    power = (np.abs(weight * model) ** 2).sum(axis=2)
    with np.errstate(divide="ignore", invalid="ignore"):
        relative = by_gain / gains
        of_noise = np.where(power > 0, max(chi2, 1.0) / (power * np.abs(gains) ** 2), np.nan)
    # A force factor is found with the gain: their product is what moves the plate.
    space, numbers = problem.plate.model.space, np.flatnonzero(searched)
    for era, factor in enumerate(space.indices("force_factor")):
        relative[numbers == factor, :, era] += space.std[factor]
    # What else is searched changes gain and field the opposite ways: sensors hear their product.
    reads = space.of("sensor_scale", "sensor_place")[searched]
    by_reading = np.tensordot(root[reads].T, relative[reads], axes=1)
    common = np.nanmean(by_reading, axis=(1, 2), keepdims=True)
    beside = by_reading - common
    return Fit(
        z,
        noise,
        used,
        error,
        gains,
        np.abs(gains)
        * np.sqrt(of_noise + (np.tensordot(root.T, relative.real, axes=1) ** 2).sum(axis=0)),
        np.sqrt(of_noise + (np.array([beside.real, beside.imag]) ** 2).sum(axis=1)),
        float(np.linalg.norm(common.real)),
        gains[:, :, None] * model,
        chi2,
        _dampers(problem, found.x, root),
    )


def _errors(
    problem: CalibrationProblem, found: Minimum, used: NDArray[np.bool_]
) -> tuple[FloatArray, FloatArray, float]:
    """Standard errors (p,), what is searched by one along each direction (n, k), and chi²."""
    searched, rows = problem.searched, int(used.any(axis=2).sum())
    freedom = max(len(found.residuals) - 2 * rows - int(searched.sum()), 1)
    chi2 = float((found.residuals**2).sum()) / freedom
    _, root, blind = _directions(found)
    root = root * math.sqrt(max(chi2, 1.0))
    error = np.zeros(len(found.x))
    error[searched] = np.where(blind, np.inf, np.linalg.norm(root, axis=1))
    return error, root, chi2


def _dampers(problem: CalibrationProblem, z: FloatArray, root: FloatArray) -> float:
    """By how much the loss factor is off, relative, where all dampers are by a share of theirs.

    root (n, k): what is searched by one standard error along each direction.
    """
    plate, moved = problem.plate, np.zeros((len(z), root.shape[1]))
    moved[problem.searched] = root
    kinds = np.array([each.kind for each in plate.rows])
    values = plate.values(z) / plate.model.space.scale[plate.numbers]
    relative = moved[plate.numbers] / np.where(values > 0, values, np.inf)[:, None]
    dampers = relative[(kinds == "damping") & problem.free]
    losses = relative[kinds == "loss_factor"][0]
    slopes = np.linalg.lstsq(dampers @ dampers.T, dampers @ losses)[0]
    return abs(float(slopes.sum()))


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
