"""The drive mode `graded`: amplitudes without phases, all ERAs at one frequency."""

import numpy as np

from model.arrays import Complex64Array, Float32Array
from model.drive_modes.coherent import Coherent
from model.drive_modes.signed import solve_signed

EXCHANGES = 8
SWEEPS = 2


def _solve(R: Complex64Array, c: Complex64Array, similar: Complex64Array | None) -> Complex64Array:
    """Minimise w^T Re(R) w / 2 - Re(c) w over w >= 0, for many forms at once.

    Block principal pivoting (Judice and Pires, Comput. Oper. Res. 21 (1994) 587-596): solve for the
    weights assumed positive, then exchange those of the wrong sign, in the forms that have any; few
    do after three iterations, or one from a similar solution. It may cycle: a few coordinate sweeps
    follow for the forms left.
    """
    w = np.empty_like(c.real)
    left, form, pull = np.arange(len(w)), np.ascontiguousarray(R.real), np.ascontiguousarray(c.real)
    driven = pull > 0 if similar is None else similar.real > 0
    # A weight outside the set is held at zero by a row of its own.
    identity = np.eye(w.shape[1], dtype=form.dtype)
    for _ in range(EXCHANGES):
        both = driven[:, :, None] & driven[:, None, :]
        found = np.linalg.solve(np.where(both, form, identity), (driven * pull)[..., None])[..., 0]
        w[left] = found
        wrong = np.where(driven, found < 0, np.matvec(form, found) < pull)
        again = np.logical_or.reduce(wrong, axis=1).nonzero()[0]
        left = left[again]
        if len(left) == 0:
            break
        form, pull, driven = form[again], pull[again], driven[again] ^ wrong[again]
    np.maximum(w, 0, out=w)
    if len(left):
        w[left] = _swept(w[left], form, pull)
    return np.asarray(w, dtype=np.complex64)


def _swept(w: Float32Array, form: Float32Array, pull: Float32Array) -> Float32Array:
    """Coordinate descent: optimise the weights (n, eras) of each ERA in turn."""
    for _ in range(SWEEPS):
        for era in range(w.shape[1]):
            others = (form[:, era] * w).sum(axis=1) - form[:, era, era] * w[:, era]
            w[:, era] = np.maximum(pull[:, era] - others, 0) / form[:, era, era]
    return w


GRADED = Coherent(_solve, phases=(5, 5), iterations=3, bound=solve_signed)
"""With several starting phases of a target, since weights cannot be negative.

Bounded by signed weights, of which its own are some.
"""
