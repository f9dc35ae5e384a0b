"""Dual weights: their bound is the contrast of the best mixture, found by another program."""

import numpy as np
import pytest
from scipy.optimize import linprog

from model.drive_modes.dual_weights import dual_weights


def sources(seed):
    """Powers of 40 sources at 80 quiet fingertips."""
    return np.random.default_rng(seed).exponential(size=(40, 80))


@pytest.mark.parametrize("seed", range(4))
def test_dual_weights_reach_the_primal_optimum(seed):
    """The primal program has the same value, to a thousandth."""
    relative = sources(seed)
    n, points = relative.shape
    primal = linprog(
        np.append(np.zeros(n), 1.0),
        A_ub=np.column_stack([relative.T, -np.ones(points)]),
        b_ub=np.zeros(points),
        A_eq=[np.append(np.ones(n), 0.0)],
        b_eq=[1.0],
        method="highs-ipm",
    )
    share = dual_weights(np.ones(n), relative)
    bound = 1 / (relative @ share).min()
    assert share.sum() == pytest.approx(1.0)
    assert (share >= 0).all()
    assert 1 / primal.fun <= bound * (1 + 1e-9)
    assert bound == pytest.approx(1 / primal.fun, rel=2e-3)
