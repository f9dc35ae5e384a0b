"""Expected powers of fields on plates whose parameters are uncertain, as Hermitian forms."""

from collections.abc import Sequence

import numpy as np

from model.arrays import Complex64Array, Float32Array

RIDGE = 1e-6
"""Share of a form's mean diagonal that is added to it, which keeps it definite."""


def expected_power(
    fields: Sequence[Complex64Array],
    own: Complex64Array,
    weights: Float32Array,
    *,
    gain_variance: float,
    error_power: Float32Array,
    shares: Float32Array | None = None,
) -> Complex64Array:
    """Compute expected powers R (f, g, n, n) at g groups of points.

    fields: h and each of its changes (f, g, p, n); own (f, g, j, n): RMS changes over the points
    due to the stiffness of each attachment, the load of each finger and the positions of fingers;
    weights (g, p): of the points; error_power (f, ..., n): mean square error of each ERA's field;
    shares (f, n, n): by which delays of amplifiers increase the power of h.
    """
    frequency_count, group_count, _, era_count = own.shape
    root_weights = np.sqrt(weights)[..., None]
    weighted = [field * root_weights for field in fields]
    power = gram(np.concatenate([*weighted, own], axis=2))
    if shares is not None:
        power += shares[:, None] * gram(weighted[0])
    field_power = (weights[:, None] @ power_of(fields[0]))[:, :, 0]
    diagonal = power.reshape(frequency_count, group_count, -1)[..., :: era_count + 1]
    values = diagonal.real + np.float32(gain_variance) * field_power + error_power
    ridge = np.float32(RIDGE / era_count) * values.sum(axis=-1, keepdims=True)
    diagonal[:] = values + ridge
    return power


def gram(rows: Complex64Array) -> Complex64Array:
    """Return the forms (..., n, n) of sums over rows (..., rows, n)."""
    return rows.conj().swapaxes(-1, -2) @ rows


def outer(rows: Complex64Array) -> Complex64Array:
    """Return the forms conj(h) h^T (..., n, n) of rows h (..., n)."""
    return rows.conj()[..., :, None] * rows[..., None, :]


def power_of(values: Complex64Array) -> Float32Array:
    """Return squared magnitudes."""
    return values.real * values.real + values.imag * values.imag
