"""Variable projection of gains, and measures of responses over sensors.

    d_fes = g_fe a_fes + noise

d measured, a of the model, g the gain at frequency f of ERA e. Gains enter linearly: the best ones
follow from any model, so that only its parameters are searched (Golub and Pereyra, SIAM J. Numer.
Anal. 10, 1973).
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from model.arrays import ComplexArray, FloatArray

_STEP = float(np.sqrt(np.finfo(float).eps))  # of a difference, relative


def project_gains(
    model: ComplexArray,
    values: ComplexArray,
    weight: FloatArray,
    *,
    expected: FloatArray | None = None,
    tolerance: float = 0.0,
) -> tuple[ComplexArray, ComplexArray]:
    """Return gains (f, e) that minimize sum |weight (values - gain model)|², and that residual.

    model (..., f, e, s); values, weight (f, e, s), weight zero where nothing was measured; the
    result has the leading dimensions of model. expected (..., e):
    magnitudes known beforehand to a relative standard deviation `tolerance`; they add
    ((|gain| - expected) / (tolerance expected))² to each row. Without them the gain of a row
    without values is NaN.
    """
    values = np.where(weight > 0, values, 0)
    squares = weight**2
    inner = np.einsum("...s,...s->...", model, squares * values.conj()).conj()
    power = np.einsum("...s,...s->...", model.real**2 + model.imag**2, squares)
    if expected is None:
        gains = np.where(power > 0, inner / np.where(power > 0, power, 1), np.nan)
    else:
        expected = expected[..., None, :]
        precision = 1 / (tolerance * expected) ** 2
        size = np.abs(inner)
        magnitude = (size + precision * expected) / (power + precision)
        gains = magnitude * np.where(size > 0, inner / np.where(size > 0, size, 1), 1)
    residual = weight * (values - np.nan_to_num(gains)[..., None] * model)
    return gains, residual


def jacobian_of(
    residuals: Callable[[FloatArray], FloatArray], lower: FloatArray, upper: FloatArray
) -> Callable[[FloatArray], FloatArray]:
    """Jacobian (m, n) of residuals by forward differences, all of them in one call.

    residuals: from (..., n) to (..., m). Steps that would leave the bounds (n,) go backwards.
    """

    def jacobian(z: FloatArray) -> FloatArray:
        step = _STEP * np.where(z < 0, -1.0, 1.0) * np.maximum(1.0, np.abs(z))
        leaves = (z + step > upper) | (z + step < lower)
        moved = z + np.diag(np.where(leaves, -step, step))
        found = residuals(np.vstack([z, moved]))
        return np.asarray(((found[1:] - found[0]) / (np.diagonal(moved) - z)[:, None]).T)

    return jacobian


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
