"""Variable projection of gains, and measures of responses over sensors.

    d_fes = g_fe a_fes + noise

d measured, a of the model, g the gain at frequency f of ERA e. Gains enter linearly: the best ones
follow from any model, so that only its parameters are searched, with the derivatives of gains and
residual by these (Golub and Pereyra, SIAM J. Numer. Anal. 10, 1973).
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from model.arrays import ComplexArray, FloatArray
from model.identification.derivatives import jacobian
from model.identification.forward import ForwardModel
from model.identification.least_squares import Minimum, search


def fit_with_gains(
    model: ForwardModel,
    values: ComplexArray,
    weight: FloatArray,
    start: FloatArray,
    searched: NDArray[np.bool_],
    *,
    prior: tuple[FloatArray, FloatArray] | None = None,
    robust: float | None = None,
    drives: Sequence[int] | None = None,
    tolerance: float | None = None,
) -> Minimum:
    """Fit some parameters (p,) of a model to values (f, e, s), every gain g beside them.

    weight (f, e, s): zero where nothing was measured; start (p,), of which searched are changed;
    prior, robust: see `search`; drives (e,): number of the ERA that each channel drives, its own by
    default; tolerance: relative standard deviation of |g| from 1, none by default.
    """
    inside = weight > 0
    rows, of_eras = inside.any(axis=2), slice(None) if drives is None else list(drives)

    def linearised(z: FloatArray) -> tuple[ComplexArray, ComplexArray]:
        found, by_z = responses_of(model, z, searched)
        found, by_z = found[:, of_eras], by_z[:, :, of_eras]
        gains, left = project_gains(found, values, weight, tolerance=tolerance)
        by_gain, slopes = projection_slopes(found, by_z, values, weight, tolerance=tolerance)
        if tolerance is None:
            return left[inside], slopes[:, inside].T
        size = np.abs(gains)
        wander = ((size - 1) / tolerance)[rows]
        by_wander = ((gains.conj() * by_gain).real / size / tolerance)[:, rows]
        return (
            np.concatenate([left[inside], wander]),
            np.hstack([slopes[:, inside], by_wander]).T,
        )

    bounds = np.array([model.space.lower, model.space.upper])
    return search(linearised, start, bounds, searched, prior=prior, robust=robust)


def responses_of(
    model: ForwardModel, z: FloatArray, searched: NDArray[np.bool_]
) -> tuple[ComplexArray, ComplexArray]:
    """Responses (f, e, s) as sensors read them, and derivatives (n, f, e, s) by n searched."""
    plate = model.at(z)
    by_z = jacobian(plate, searched)[..., searched].transpose(3, 0, 2, 1)
    return np.swapaxes(plate.responses, 1, 2), by_z


def project_gains(
    model: ComplexArray,
    values: ComplexArray,
    weight: FloatArray,
    *,
    tolerance: float | None = None,
) -> tuple[ComplexArray, ComplexArray]:
    """Return gains (f, e) that minimize sum |weight (values - gain model)|², and that residual.

    model, values, weight (f, e, s), weight zero where nothing was measured; the gain of a row
    without values is NaN. tolerance: relative standard deviation of |gain| from 1, which adds
    ((|gain| - 1) / tolerance)² to each row.
    """
    values = np.where(weight > 0, values, 0)
    inner, power = _inner_and_power(model, values, weight)
    if tolerance is None:
        gains = np.where(power > 0, inner / np.where(power > 0, power, 1), np.nan)
    else:
        size, precision = np.abs(inner), tolerance**-2
        magnitude = (size + precision) / (power + precision)
        gains = magnitude * np.where(size > 0, inner / np.where(size > 0, size, 1), 1)
    residual = weight * (values - np.nan_to_num(gains)[..., None] * model)
    return gains, residual


def projection_slopes(
    model: ComplexArray,
    slopes: ComplexArray,
    values: ComplexArray,
    weight: FloatArray,
    *,
    tolerance: float | None = None,
) -> tuple[ComplexArray, ComplexArray]:
    """Derivatives (n, f, e) of the gains of `project_gains`, and (n, f, e, s) of the residual.

    slopes (n, f, e, s): derivatives of the model.
    """
    values = np.where(weight > 0, values, 0)
    inner, power = _inner_and_power(model, values, weight)
    gains = np.nan_to_num(project_gains(model, values, weight, tolerance=tolerance)[0])
    by_inner = np.einsum("nfes,fes->nfe", slopes.conj(), weight**2 * values)
    by_power = 2 * np.einsum("nfes,fes->nfe", slopes, weight**2 * model.conj()).real
    if tolerance is None:
        by_gain = (by_inner - gains * by_power) / np.where(power > 0, power, 1)
    else:
        size = np.where(np.abs(inner) > 0, np.abs(inner), 1)
        phase_factor = np.where(np.abs(inner) > 0, inner / size, 1)
        turned = phase_factor.conj() * by_inner
        by_magnitude = (turned.real - np.abs(gains) * by_power) / (power + tolerance**-2)
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
