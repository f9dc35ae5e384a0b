"""Variable projection of gains, and measures of responses over sensors.

    d_fes = g_fe a_fes + noise

d measured, a of the model, g the gain at frequency f of ERA e. Gains enter linearly: the best ones
follow from any model, so that only its parameters are searched, with the derivatives of gains and
residual by these (Golub and Pereyra, SIAM J. Numer. Anal. 10, 1973).
"""

import numpy as np
from numpy.typing import NDArray

from model.arrays import ComplexArray, FloatArray


def project_gains(
    model: ComplexArray,
    values: ComplexArray,
    weight: FloatArray,
    *,
    expected: FloatArray | None = None,
    tolerance: float = 0.0,
) -> tuple[ComplexArray, ComplexArray]:
    """Return gains (f, e) that minimize sum |weight (values - gain model)|², and that residual.

    model, values, weight (f, e, s), weight zero where nothing was measured. expected (e,):
    magnitudes known beforehand to a relative standard deviation `tolerance`; they add
    ((|gain| - expected) / (tolerance expected))² to each row. Without them the gain of a row
    without values is NaN.
    """
    values = np.where(weight > 0, values, 0)
    inner, power = _inner_and_power(model, values, weight)
    if expected is None:
        gains = np.where(power > 0, inner / np.where(power > 0, power, 1), np.nan)
    else:
        precision = 1 / (tolerance * expected) ** 2
        size = np.abs(inner)
        magnitude = (size + precision * expected) / (power + precision)
        gains = magnitude * np.where(size > 0, inner / np.where(size > 0, size, 1), 1)
    residual = weight * (values - np.nan_to_num(gains)[..., None] * model)
    return gains, residual


def projection_slopes(
    model: ComplexArray,
    slopes: ComplexArray,
    values: ComplexArray,
    weight: FloatArray,
    *,
    expected: FloatArray | None = None,
    expected_slopes: FloatArray | None = None,
    tolerance: float = 0.0,
) -> tuple[ComplexArray, ComplexArray]:
    """Derivatives (n, f, e) of the gains of `project_gains`, and (n, f, e, s) of the residual.

    slopes (n, f, e, s), expected_slopes (n, e): derivatives of model and expected.
    """
    values = np.where(weight > 0, values, 0)
    inner, power = _inner_and_power(model, values, weight)
    gains, _ = project_gains(model, values, weight, expected=expected, tolerance=tolerance)
    gains = np.nan_to_num(gains)
    by_inner = np.einsum("nfes,fes->nfe", slopes.conj(), weight**2 * values)
    by_power = 2 * np.einsum("nfes,fes->nfe", slopes, weight**2 * model.conj()).real
    if expected is None or expected_slopes is None:
        by_gain = (by_inner - gains * by_power) / np.where(power > 0, power, 1)
    else:
        precision = 1 / (tolerance * expected) ** 2
        by_expected = expected_slopes[:, None]
        size = np.where(np.abs(inner) > 0, np.abs(inner), 1)
        phase_factor = np.where(np.abs(inner) > 0, inner / size, 1)
        turned = phase_factor.conj() * by_inner
        by_precision = -2 * precision / expected * by_expected
        by_magnitude = turned.real - precision * by_expected
        by_magnitude -= np.abs(gains) * (by_power + by_precision)
        by_magnitude /= power + precision
        by_gain = phase_factor * (by_magnitude + 1j * np.abs(gains) / size * turned.imag)
    return by_gain, -weight * (by_gain[..., None] * model + gains[..., None] * slopes)


def _inner_and_power(
    model: ComplexArray, values: ComplexArray, weight: FloatArray
) -> tuple[ComplexArray, FloatArray]:
    """Weighted inner products of model and values, and squares of the model, (f, e)."""
    squares = weight**2
    inner = np.einsum("fes,fes->fe", model.conj(), squares * values)
    power = np.einsum("fes,fes->fe", model.real**2 + model.imag**2, squares)
    return np.asarray(inner), np.asarray(power)


def row_rms(values: ComplexArray, used: NDArray[np.bool_] | None = None) -> FloatArray:
    """Root mean square of each row of values (f, e, s) over its sensors; 1 for an empty row."""
    used = np.isfinite(values) if used is None else used
    power = np.where(used, np.abs(np.where(used, values, 0)) ** 2, 0).sum(axis=2)
    rms = np.sqrt(power / np.maximum(used.sum(axis=2), 1))
    return np.where(rms > 0, rms, 1.0)


def modal_assurance(values: ComplexArray, model: ComplexArray) -> FloatArray:
    """Modal assurance criterion |a^H d|² / (|a|² |d|²) of shapes (..., s); NaN of empty ones.

    1 for the same shape with any gain, about 1/s for noise. Values that are not finite are ignored.
    """
    measured = np.isfinite(values)
    values = np.where(measured, values, 0)
    model = np.where(measured, model, 0)
    inner = np.abs((model.conj() * values).sum(axis=-1)) ** 2
    power = (np.abs(values) ** 2).sum(axis=-1) * (np.abs(model) ** 2).sum(axis=-1)
    return np.where(power > 0, inner / np.where(power > 0, power, 1), np.nan)
