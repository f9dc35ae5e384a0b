"""The drive mode `graded`: amplitudes without phases, all ERAs at one frequency."""

import numpy as np

from model.drive_modes.coherent import Coherent
from model.drive_modes.fields import SingleComplex

SWEEPS = 12


def _solve(R: SingleComplex, c: SingleComplex) -> SingleComplex:
    """Minimise w^T Re(R) w / 2 - Re(c) w over w >= 0, one coordinate after the other."""
    form, pull = R.real, c.real
    w = np.maximum(pull, 0) / np.diagonal(form, axis1=1, axis2=2)
    for _ in range(SWEEPS):
        for era in range(pull.shape[1]):
            others = (form[:, era] * w).sum(axis=1) - form[:, era, era] * w[:, era]
            w[:, era] = np.maximum(pull[:, era] - others, 0) / form[:, era, era]
    return np.asarray(w, dtype=np.complex64)


GRADED = Coherent(_solve, phases=(5, 5), ascents=4)
