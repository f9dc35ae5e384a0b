"""Gains of drives: the complex gains for which a model's responses fit measured values best.

The gain g of a drive at a frequency multiplies the model's responses a_s at all sensors. With
measured values d_s of weight w_s, and a standard deviation sigma of |g| from 1, it minimizes

    sum_s w_s² |d_s - g a_s|² + (|g| - 1)² / sigma²,

g = |g| p,    p = b / |b|,    |g| = (|b| + 1 / sigma²) / c,
b = sum_s w_s² a_s* d_s,      c = sum_s w_s² |a_s|² + 1 / sigma².

The derivatives of g let a fit search only the parameters of the model (variable projection: Golub
and Pereyra, SIAM J. Numer. Anal. 10, 1973).
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from model.arrays import ComplexArray, FloatArray
from model.estimate.measurement import Measurement


class GainFit(NamedTuple):
    """The best gains of a model, and the residuals of the m measured values with these gains."""

    gains: ComplexArray
    """Gains (f, n): 1 if fixed, NaN if free but not measured."""
    gain_slopes: ComplexArray
    """Derivatives of the gains by q parameters (f, n, q)."""
    residuals: ComplexArray
    """Residuals in standard errors (m,)."""
    slopes: ComplexArray
    """Derivatives of the residuals (m, q)."""


def best_gains(responses: ComplexArray, slopes: ComplexArray, measurement: Measurement) -> GainFit:
    """Find the best gains of a model's responses (f, s, n) with slopes (f, s, n, q).

    Gains with a stated standard deviation are drawn toward magnitude 1.
    """
    gains = np.ones((len(responses), responses.shape[2]), dtype=complex)
    gain_slopes = np.zeros((*gains.shape, slopes.shape[-1]), dtype=complex)
    valid = measurement.known
    if measurement.gain_std:
        gains, gain_slopes = _free_gains(responses, slopes, measurement)
        slopes = gain_slopes[:, None] * responses[..., None] + gains[:, None, :, None] * slopes
        responses = gains[:, None] * responses
        gains = np.where(valid.any(axis=1), gains, np.nan)
    weight = measurement.weight[valid]
    return GainFit(
        gains=gains,
        gain_slopes=gain_slopes,
        residuals=weight * (responses - measurement.filled)[valid],
        slopes=weight[:, None] * slopes[valid],
    )


def _free_gains(
    responses: ComplexArray, slopes: ComplexArray, measurement: Measurement
) -> tuple[ComplexArray, ComplexArray]:
    """Return the best gains (f, n), and their derivatives (f, n, q)."""
    values = measurement.filled
    weight = measurement.weight
    squared_weight = weight**2
    weighted = squared_weight * responses.conj()
    precision = measurement.gain_std**-2
    power = ((weight * np.abs(responses)) ** 2).sum(axis=1) + precision  # c
    power = np.where(power > 0, power, 1.0)
    product = (weighted * values).sum(axis=1)  # b
    is_zero = product == 0
    length = np.where(is_zero, 1.0, np.abs(product))
    phasor = np.where(is_zero, 1.0, product / length)  # p
    size = (np.abs(product) + precision) / power  # |g|

    # Derivatives of b / p, whose real part is d|b| and whose imaginary part is |b| d(arg p).
    product_slopes = np.einsum("fsnq,fsn->fnq", slopes.conj(), squared_weight * values)
    product_slopes = product_slopes * phasor.conj()[..., None]
    power_slopes = 2 * np.einsum("fsnq,fsn->fnq", slopes, weighted).real
    size_slopes = (product_slopes.real - size[..., None] * power_slopes) / power[..., None]
    phase_slopes = (size / length)[..., None] * product_slopes.imag  # |g| d(arg p)
    return size * phasor, phasor[..., None] * (size_slopes + 1j * phase_slopes)


def gain_residuals(gain_fit: GainFit, std: float) -> tuple[ComplexArray, ComplexArray]:
    """Return residuals (k,) of the gains' magnitudes from 1, and their derivatives (k, q).

    Empty if gains are fixed (std 0) or unknown (std infinite).
    """
    gains = gain_fit.gains
    is_held = np.isfinite(gains) & np.isfinite(std) & np.bool_(std > 0)
    held = gains[is_held]
    size = np.abs(held)
    size_slopes = (held.conj()[:, None] * gain_fit.gain_slopes[is_held]).real
    size_slopes = size_slopes / size[:, None]
    return (size - 1) / std + 0j, size_slopes / std + 0j


def gains_of(
    model: ComplexArray, values: ComplexArray, weight: FloatArray | float = 1.0
) -> ComplexArray:
    """Return the gains (f, n) of a model (f, s, n) that fit values best, NaN if undetermined."""
    squares = np.where(np.isfinite(values), weight, 0.0) ** 2
    values = np.where(squares > 0, values, 0)
    inner = (squares * model.conj() * values).sum(axis=1)
    power = (squares * np.abs(model) ** 2).sum(axis=1)
    is_determined = power > 0
    gains = inner / np.where(is_determined, power, 1)
    return np.where(is_determined, gains, np.nan)


def row_rms(values: ComplexArray) -> FloatArray:
    """Return the RMS of values (f, s, n) over the sensors (f, 1, n), 1 without any."""
    measured = np.isfinite(values)
    power = np.where(measured, np.abs(values) ** 2, 0).sum(axis=1, keepdims=True)
    count = np.maximum(measured.sum(axis=1, keepdims=True), 1)
    rms = np.sqrt(power / count)
    return np.where(rms > 0, rms, 1.0)


def are_impossible(
    gains: ComplexArray, size: FloatArray | float, phase: float = math.inf
) -> NDArray[np.bool_]:
    """Return a mask of relative gains that no drive and no sensor can have.

    size: largest logarithm of the magnitude, up or down; phase: largest phase [rad].
    """
    sizes = np.abs(np.log(np.abs(gains)))
    return (sizes > size) | (np.abs(np.angle(gains)) > phase)
