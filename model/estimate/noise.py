"""Noise of measured values, estimated from the residuals of a fit, and outliers.

A row is the values of all sensors at one frequency and channel. Its noise is sqrt(a² + b² r²) for a
row with RMS r, where a and b follow from the medians of residuals of weak and strong rows.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from model.arrays import ComplexArray, FloatArray
from model.estimate.fit import Fit, JointPrior, ModelT, fit
from model.estimate.gains import gains_of, row_rms
from model.estimate.measurement import Measurement

_ROUNDS = 8  # fits and noise estimates
_SETTLED = 0.1  # relative change of the noise between the last two rounds
_MIN_NOISE_LEFT = 0.1  # share of a value's noise; residuals with less do not show the noise
_MIN_NOISE = 1e-4  # of the response, the error of meshes and reduction
_MAX_RESIDUAL = 5.0  # standard errors; exceeded by 0.04 of 10 000 good complex values
_MAX_GROUPS = 12  # of rows by amplitude, each with its own noise
_MIN_ROWS = 4  # for an estimate of the noise


def fit_to_noise(
    model: ModelT,
    measurement: Measurement,
    *,
    searched: NDArray[np.bool_] | None = None,
    start: FloatArray | None = None,
    prior: JointPrior | None = None,
) -> Fit[ModelT]:
    """Fit with errors estimated from the residuals, and without outliers.

    The measurement in the result has these errors, infinite for outliers.
    """
    result = fit(model, measurement, searched=searched, start=start, prior=prior)
    for _ in range(_ROUNDS):
        weighed = result.measurement
        residuals = np.abs(measurement.values - result.predicted)
        std = noise_of(weighed.part(weighed.known).values, residuals, _noise_left(result))
        is_good = residuals < _MAX_RESIDUAL * np.sqrt(2) * std
        reweighed = replace(measurement, errors=np.where(is_good, std, np.inf))
        result = fit(model, reweighed, searched=searched, start=result.x, prior=prior)
        if _is_settled(weighed, reweighed):
            break
    return result


def _noise_left(result: Fit[ModelT]) -> FloatArray:
    """Return the fraction of each value's noise power that a fit leaves in its residual (f, s, n).

    Free gains and searched parameters absorb the rest.
    """
    measurement = result.measurement
    absorbed = np.abs(measurement.weight * result.predicted) ** 2 * bool(measurement.gain_std)
    total = absorbed.sum(axis=1, keepdims=True)
    fraction = 1 - absorbed / np.where(total > 0, total, 1)
    fraction[measurement.known] -= result.leverage
    return fraction


def _is_settled(former: Measurement, latter: Measurement) -> bool:
    """Whether two noise estimates nearly agree, with the same outliers."""
    if (former.known != latter.known).any():
        return False
    valid = latter.known
    return np.allclose(former.std[valid], latter.std[valid], rtol=_SETTLED)


def without_outliers(values: ComplexArray, model: ComplexArray) -> tuple[FloatArray, FloatArray]:
    """Find the outliers of values (f, s, n) relative to a plate's responses, up to a gain per row.

    Removes the worst value of a row first, since each biases the row's gain. Returns the errors of
    each part as estimated from the remaining values, infinite for outliers (f, s, n), and the
    scales of the sensors (s,).
    """
    used = np.isfinite(values)
    scales = np.ones(values.shape[1])
    for _ in range(_ROUNDS):
        good = np.where(used, values, np.nan)
        gains = np.nan_to_num(gains_of(scales[:, None] * model, good))
        predicted = gains[:, None] * model
        scales = _sensor_scales(good, predicted, scales)
        residuals = np.abs(values - scales[:, None] * predicted)
        std = np.where(used, noise_of(good, residuals, _left_by_row_gain(used)), np.inf)
        relative = np.where(used, residuals / std / np.sqrt(2), 0.0)
        remaining = used & ~_row_outliers(relative, used)
        if (remaining == used).all():
            break
        used = remaining
    return np.where(used, std, np.inf), scales


def _sensor_scales(values: ComplexArray, predicted: ComplexArray, former: FloatArray) -> FloatArray:
    """Return the scale of each sensor relative to the others (s,), from values (f, s, n).

    former (s,): kept by sensors without values.
    """
    used = np.isfinite(values)
    has_values = used.any(axis=(0, 2))
    ratio = np.divide(values, predicted, out=np.full_like(values, np.nan), where=used)
    scales = former.copy()
    scales[has_values] = np.nanmedian(ratio.real[:, has_values], axis=(0, 2))
    return scales / np.median(scales)


def _left_by_row_gain(used: NDArray[np.bool_]) -> FloatArray:
    """Return the fraction of each value's noise power (f, s, n) that the gain of its row leaves.

    The gain uses up one of the row's values.
    """
    count = used.sum(axis=1, keepdims=True)
    return np.broadcast_to(1 - 1 / np.maximum(count, 2), used.shape)


def _row_outliers(relative: FloatArray, used: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return a mask (f, s, n) of the worst value of each row of more than two, if too far off.

    relative (f, s, n): residuals in standard errors.
    """
    worst = relative.max(axis=1, keepdims=True)
    is_far_off = (worst > _MAX_RESIDUAL) & (used.sum(axis=1, keepdims=True) > 2)
    return np.asarray((relative == worst) & is_far_off)


def noise_of(values: ComplexArray, residuals: FloatArray, fraction: FloatArray) -> FloatArray:
    """Return the error (f, 1, n) of the real and of the imaginary part of values (f, s, n).

    residuals (f, s, n): of a fit; fraction (f, s, n): of the noise power that the fit leaves in
    each residual.
    """
    valid = np.isfinite(values)
    size = row_rms(values)
    floor = _MIN_NOISE * size
    rows = np.flatnonzero((valid.sum(axis=1) >= 2).ravel())
    if len(rows) < _MIN_ROWS:
        return floor
    shows_noise = valid & (fraction > _MIN_NOISE_LEFT)
    power = residuals**2 / np.where(shows_noise, fraction, 1) / 2
    power = np.where(shows_noise, power, np.nan)
    by_row = power.swapaxes(1, 2).reshape(-1, values.shape[1])
    constant, proportional = _noise_law(by_row[rows], size.ravel()[rows])
    return np.asarray(np.sqrt(constant + proportional * size**2 + floor**2))


def _noise_law(power: FloatArray, sizes: FloatArray) -> tuple[float, float]:
    """Return a² and b² of rows whose noise power is a² + b² r².

    power (rows, s): of the noise in each value, NaN if unknown; sizes (rows,): r. Fitted to the
    medians of groups of rows of similar size, relative to each median.
    """
    from scipy.optimize import nnls

    noise_powers = []
    row_powers = []
    order = np.argsort(sizes, kind="stable")
    for group in np.array_split(order, min(_MAX_GROUPS, len(order) // 2)):
        # The median of |z|² of complex noise with variance 2 is 2 log 2.
        noise_powers.append(np.nanmedian(power[group]) / np.log(2))
        row_powers.append(np.median(sizes[group] ** 2))
    scale = np.maximum(noise_powers, 1e-12 * np.array(row_powers))
    matrix = np.column_stack([1 / scale, np.array(row_powers) / scale])
    weight = np.linalg.norm(matrix, axis=0)
    solution, _ = nnls(matrix / weight, np.ones(len(scale)))
    constant, proportional = (solution / weight).tolist()
    return constant, proportional
