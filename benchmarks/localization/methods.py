"""Two of the methods that the paper cites, from their definitions, on the same plate.

Both take the transfer functions from each ERA to points on the plate, as the table has them, and
both are given the best of the 27 frequencies for every contact set.
"""

import numpy as np

from benchmarks.localization.cases import LEAST, NO_ERRORS, Errors
from model.arrays import Complex64Array, ComplexArray, FloatArray, IntArray
from model.drive_modes.fields import Fields
from model.finger.contrast import contrast_db


def inverse_filter(fields: Fields, centres: IntArray) -> ComplexArray:
    """Pseudo-inverse of the transfer matrix to the centres of all fingertips (its reference 20).

    Wanted: 1 at the target, 0 at the others; full stroke where most is needed. centres: which of
    the quiet points are.
    """
    points = np.concatenate([fields.targets[0][:, :, :1], fields.quiet[:, :, centres]], axis=2)
    wanted = np.zeros(points.shape[2])
    wanted[0] = 1.0
    weights = np.linalg.pinv(points.transpose(0, 2, 1).astype(complex)) @ wanted.astype(complex)
    return _best_frequency(fields, weights)


def time_reversal(fields: Fields) -> ComplexArray:
    """The target's own answer turned round in time, of one frequency: its conjugate (17, 18)."""
    return _best_frequency(fields, fields.targets[0][:, :, 0].conj().astype(complex))


def reversed_pulse_contrast(fields: Fields, errors: Errors, *, samples: int = 512) -> FloatArray:
    """Contrast [dB] (draws,) of a pulse of all frequencies at once, focused at the target.

    Frequencies come at a fixed step, so the field repeats; peaks are over one period.
    """
    weights = fields.targets[0][:, :, 0].conj()
    time = np.arange(samples) / samples
    turn = np.exp(2j * np.pi * np.outer(np.arange(fields.frequency_count), time))

    def peak(field: Complex64Array, factor: ComplexArray) -> FloatArray:
        tones = np.einsum("fe,fep->pf", weights * factor, field)
        # The envelope of the analytic signal: what the step's offset turns is common to all.
        return np.asarray(np.abs(tones @ turn).max(axis=-1))

    return np.array(
        [
            float(contrast_db([peak(fields.targets[0], f)], peak(fields.quiet, f)))
            for f in errors.factors
        ]
    )


def _best_frequency(fields: Fields, weights: ComplexArray) -> ComplexArray:
    weights = weights / np.abs(weights).max(axis=1, keepdims=True)
    best, most = np.zeros_like(weights), -np.inf
    for frequency in range(len(weights)):
        only = np.zeros_like(weights)
        only[frequency] = weights[frequency]
        if np.abs(weights[frequency] @ fields.targets[0][frequency]).mean() < LEAST:
            continue
        contrast = NO_ERRORS.contrast_db(fields, only)[0]
        if contrast > most:
            best, most = only, contrast
    return best
