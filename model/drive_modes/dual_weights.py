"""Weights of the quiet fingertips whose weighted mean bounds the ratio of every mixture of sources.

A mixture x >= 0, sum x = 1, of sources with target power 1 and quiet powers q_n has a maximum of at
least v . sum x_n q_n for any v >= 0 of sum 1. By linear programming duality the best mixture and
the best v have the same value, so that max_n power_n / (v . quiet_n) is the least upper bound of
a mixture's ratio.
"""

import numpy as np

from model.arrays import FloatArray


def dual_weights(power: FloatArray, quiet: FloatArray) -> FloatArray:
    """Weights v of the quiet fingertips (q,) that give the least upper bound.

    power (n,): of each source at the targets; quiet (n, q): its powers at the quiet fingertips.
    """
    if quiet.shape[1] == 1:
        return np.ones(1)
    from scipy.optimize import linprog  # loads for a fifth of a second, only where it is needed

    relative = quiet / np.maximum(power, 1e-12 * power.max())[:, None]
    n, count = relative.shape
    found = linprog(
        np.append(np.zeros(n), 1.0),
        A_ub=np.column_stack([relative.T, -np.ones(count)]),
        b_ub=np.zeros(count),
        A_eq=[np.append(np.ones(n), 0.0)],
        b_eq=[1.0],
        bounds=[(0, None)] * n + [(None, None)],
        method="highs-ds",
    )
    weights = np.maximum(-found.ineqlin.marginals, 0)
    return np.asarray(weights / weights.sum())
