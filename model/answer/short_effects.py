"""Short effects: forms to search, and the choice among drives by what a pulse of each does.

A target counts by the mean of its demodulated acceleration over the duration, a quiet fingertip by
its power, that after the end included.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from model.answer.fingers_on_plate import FingerForms
from model.answer.pulse_gains import OverEffect, PulseResponses, contrast_over_effect
from model.answer.search import REACHED
from model.arrays import Complex64Array, FloatArray
from model.choice import best_of
from model.drive_modes.forms import Drive, Forms
from model.ensemble.measures import percentile
from model.ensemble.touched_plate import gram
from model.transients.ringing import RINGING_TIMES, RampedRinging

_NEARLY = 10 ** (-1 / 20)  # within a decibel


def forms_over(
    steady: Forms,
    formed: FingerForms,
    targets: Sequence[int],
    quiet: Sequence[int],
    ringing: RampedRinging,
) -> Forms:
    """Forms over an effect from steady ones; ringing is that of the plate without fingers."""
    fields, few = formed.contacts.fields, formed.fingers.tips.few
    (f, k, p, n), at = fields.shape, few.reshape(-1, few.shape[2])
    real, imaginary = ringing.parts[:, formed.rows].reshape(2, -1, at.shape[1]) @ at.T
    parts = (real + 1j * imaginary).reshape(f, n, -1, k, p).transpose(0, 3, 2, 4, 1)
    over = parts + ringing.envelope[:, None, None] * fields[:, :, None]
    return _over(steady, formed, targets, quiet, over, RINGING_TIMES)


def forms_during(
    steady: Forms,
    formed: FingerForms,
    targets: Sequence[int],
    quiet: Sequence[int],
    responses: PulseResponses,
) -> Forms:
    """Forms as `forms_over` at the rows of responses, of the plate with the fingers on it."""
    over = responses.values[:, :, :-1].transpose(0, 3, 2, 4, 1).astype(np.complex64)
    some = np.searchsorted(formed.rows, responses.rows)
    return _over(steady.at(some), formed.at(some), targets, quiet, over, responses.count)


def _over(
    steady: Forms,
    formed: FingerForms,
    targets: Sequence[int],
    quiet: Sequence[int],
    over: Complex64Array,
    count: int,
) -> Forms:
    """Forms from fields over an effect (f, k, times, p, n); count: times until its end."""
    targets, quiet = [*targets], [*quiet]
    weights, (f, _, _, _, n) = formed.fingers.tips.few_weights, over.shape
    at = over[:, targets, :count].mean(axis=2)
    scale = np.sqrt(weights[quiet])[:, None, :, None]
    lasting, during = (
        (each[:, quiet] * scale / np.float32(math.sqrt(length))).reshape(f, len(quiet), -1, n)
        for each, length in ((formed.contacts.fields[:, :, None], 1), (over, count))
    )
    return replace(
        steady,
        targets=(at * weights[targets, :, None]).sum(axis=2).swapaxes(0, 1),
        quiet=np.ascontiguousarray(steady.quiet + gram(during) - gram(lasting)),
        level_margin=0.0,
        few=None,
        fine=None,
    )


def best_over_effect(
    drives: Sequence[Drive],
    scores: FloatArray,
    own: FloatArray,
    quiet: FloatArray,
    wanted: float,
    over_effect: OverEffect,
) -> int:
    """Index of the drive of the best contrast over the duration of an effect.

    Of those that reach the level over it on the nominal plate, or come near the strongest. own (c,
    1 + d): amplitude at the targets of the steady vibration, nominal and on drawn plates; quiet (c,
    q, 1 + d): power at the loudest point of each quiet finger.
    """
    rows = np.unique([row for drive in drives for row, _ in drive])
    responses = over_effect.responses(rows)
    gains = [responses.gains(drive) for drive in drives]
    lag = 10 ** (np.array([min(each.targets) for each in gains]) / 20)
    level = own[:, 0] * lag
    near = min(wanted * REACHED, level.max() * _NEARLY)
    if not quiet.shape[1]:
        return best_of((level >= near) * scores * lag)
    heard = 10 ** (np.array([each.quiet_db_sl for each in gains]) / 20)
    felt = own / np.maximum(np.sqrt(quiet.max(axis=1)), 1e-30)
    contrast = contrast_over_effect(level / heard, felt[:, 0], percentile(felt[:, 1:]))
    return best_of((level >= near) * contrast)
