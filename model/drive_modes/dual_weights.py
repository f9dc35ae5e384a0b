"""Weights of the quiet points whose weighted mean bounds the contrast of every mixture of sources.

A mixture x >= 0, sum x = 1, of sources with target peak 1 and quiet magnitudes q_n has a quiet norm
of at least v . sum x_n q_n for any v >= 0 of dual norm 1. By linear programming duality (for the
root mean square: that of least distance problems) the best mixture and the best v have the same
value, so that max_n peak_n / (v . quiet_n) is the least upper bound of a mixture's contrast.
"""

import math

import numpy as np

from model.arrays import FloatArray

FIRST_POINTS = 30
"""Points that the linear program begins with; louder ones are added until there are none left."""

PEAK_TOLERANCE = 1e-3
"""Relative excess over the program's peak above which a point is added."""


def dual_weights(peak: FloatArray, quiet: FloatArray, *, is_rms: bool) -> FloatArray:
    """Weights v of the quiet points (q,) that give the least upper bound.

    peak (n,): of each source at the targets; quiet (n, q): its magnitudes at the quiet points.
    is_rms: whether the points count by their root mean square, or else by their maximum.
    """
    relative = quiet / np.maximum(peak, 1e-12 * peak.max())[:, None]
    return _rms_weights(relative) if is_rms else _maximum_weights(relative)


def _rms_weights(relative: FloatArray) -> FloatArray:
    """Non-negative least squares, with sum x = 1 as a heavy row."""
    from scipy.optimize import nnls  # loads for a fifth of a second, only where it is needed

    n, points = relative.shape
    heavy = np.abs(relative).max() * n
    system = np.vstack([relative.T, np.full((1, n), heavy)])
    mixture, _ = nnls(system, np.append(np.zeros(points), heavy))
    field = relative.T @ mixture
    return np.asarray(field / np.linalg.norm(field) / math.sqrt(points))


def _maximum_weights(relative: FloatArray) -> FloatArray:
    """Marginals of the linear program min peak, field <= peak, points added while too loud."""
    from scipy.optimize import linprog  # as above

    n, points = relative.shape
    some = np.argsort(-relative.mean(axis=0))[:FIRST_POINTS]
    while True:
        found = linprog(
            np.append(np.zeros(n), 1.0),
            A_ub=np.column_stack([relative[:, some].T, -np.ones(len(some))]),
            b_ub=np.zeros(len(some)),
            A_eq=[np.append(np.ones(n), 0.0)],
            b_eq=[1.0],
            bounds=[(0, None)] * n + [(None, None)],
            method="highs-ds",
        )
        solution = np.asarray(found.x)
        field, peak = solution[:n] @ relative, solution[n]
        louder = np.setdiff1d(np.flatnonzero(field > peak * (1 + PEAK_TOLERANCE)), some)
        if len(louder) == 0:
            weights = np.zeros(points)
            weights[some] = np.maximum(-found.ineqlin.marginals, 0)
            return np.asarray(weights / weights.sum())
        some = np.append(some, louder[np.argsort(-field[louder])[:FIRST_POINTS]])
