"""The drive mode `graded`: amplitudes without phases, all ERAs at one frequency."""

import numpy as np

from model.drive_modes.coherent import Coherent
from model.drive_modes.fields import SingleComplex

EXCHANGES = 8
SWEEPS = 2


def _solve(R: SingleComplex, c: SingleComplex) -> SingleComplex:
    """Minimise w^T Re(R) w / 2 - Re(c) w over w >= 0, for many forms at once.

    Block principal pivoting (Judice and Pires, Comput. Oper. Res. 21 (1994) 587-596): solve for the
    weights taken to be above zero, then exchange those that are on the wrong side. It may circle; a
    few sweeps over the coordinates mend what is left then.
    """
    form, pull = R.real, c.real
    driven = pull > 0
    # A weight outside the set is held at zero by a row of its own.
    identity = np.eye(pull.shape[1], dtype=form.dtype)
    w = np.zeros_like(pull)
    for _ in range(EXCHANGES):
        both = driven[:, :, None] & driven[:, None, :]
        system = np.where(both, form, identity)
        w[:] = np.linalg.solve(system, np.where(driven, pull, 0)[..., None])[..., 0]
        gain = pull - (form @ w[..., None])[..., 0]
        wrong = np.where(driven, w < 0, gain > 0)
        if not wrong.any():
            break
        driven = driven ^ wrong
    np.maximum(w, 0, out=w)
    for _ in range(SWEEPS):
        for era in range(pull.shape[1]):
            others = (form[:, era] * w).sum(axis=1) - form[:, era, era] * w[:, era]
            w[:, era] = np.maximum(pull[:, era] - others, 0) / form[:, era, era]
    return np.asarray(w, dtype=np.complex64)


GRADED = Coherent(_solve, phases=(7, 5), ascents=4)
"""Weights that cannot be negative reach some phases of a target better than their opposites."""
