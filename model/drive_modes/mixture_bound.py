"""What no mixture of sources can exceed, at any amplitudes, and the quiet points that say so.

Sources with target's share 1 and quiet magnitudes q_n; a mixture x >= 0, sum x = 1, is as quiet as
the norm of sum x_n q_n, which is at least v . (sum x_n q_n) for weights v of dual norm 1. The best
mixture and the best weights meet in the middle (linear programming duality; for the root mean
square, that of least distance problems), so 1 / min_n v . q_n bounds the contrast of every mixture.
"""

import math

import numpy as np

from model.arrays import FloatArray

# The program begins with this many points, and others come in that are louder by a share of this.
FIRST_POINTS = 30
CLOSE_ENOUGH = 1e-3


def mixture_bound(relative: FloatArray, *, is_rms: bool) -> tuple[FloatArray, float]:
    """Weights v of the quiet points (q,), and the bound, a ratio.

    relative: (n, q) magnitude of each source at the quiet points, by what the target gets of it.
    is_rms: whether the points count by their root mean square, or else by their maximum.
    """
    share = _rms_weights(relative) if is_rms else _loudest_weights(relative)
    # Whatever the solver's tolerance, this holds for these weights.
    return share, float(1 / (relative @ share).min())


def _rms_weights(relative: FloatArray) -> FloatArray:
    """Non-negative least squares, with sum x = 1 as a heavy row."""
    from scipy.optimize import nnls  # a fifth of a second, which no daemon needs to wait for

    n, points = relative.shape
    heavy = np.abs(relative).max() * n
    system = np.vstack([relative.T, np.full((1, n), heavy)])
    mixture, _ = nnls(system, np.append(np.zeros(points), heavy))
    field = relative.T @ mixture
    return np.asarray(field / np.linalg.norm(field) / math.sqrt(points))


def _loudest_weights(relative: FloatArray) -> FloatArray:
    """A linear program over the loudest points; others come in where the mixture is louder."""
    from scipy.optimize import linprog  # as above

    n, points = relative.shape
    some = np.argsort(-relative.mean(axis=0))[:FIRST_POINTS]
    while True:
        answer = linprog(
            np.append(np.zeros(n), 1.0),
            A_ub=np.column_stack([relative[:, some].T, -np.ones(len(some))]),
            b_ub=np.zeros(len(some)),
            A_eq=[np.append(np.ones(n), 0.0)],
            b_eq=[1.0],
            bounds=[(0, None)] * n + [(None, None)],
            method="highs-ds",
        )
        solution = np.asarray(answer.x)
        field = solution[:n] @ relative
        level = solution[n]
        louder = np.setdiff1d(np.flatnonzero(field > level * (1 + CLOSE_ENOUGH)), some)
        if len(louder) == 0:
            share = np.zeros(points)
            share[some] = np.maximum(-answer.ineqlin.marginals, 0)
            return np.asarray(share / share.sum())
        some = np.append(some, louder[np.argsort(-field[louder])[:FIRST_POINTS]])
