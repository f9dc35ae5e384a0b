"""The polynomial for all truncated modes, against the exact function."""

import numpy as np
import pytest

from model.reduction.truncation import truncation_weights

LARGEST = 1 / 4.0e7  # the lowest truncated mode at about 1 kHz


def approximation(zeta, u, terms):
    """Sum of the weights times (u / u_c)^j."""
    powers = (u[:, None] / LARGEST) ** np.arange(1, terms + 1)
    return powers @ truncation_weights(np.array([zeta]), LARGEST, terms)[0]


def error_bound(zeta, terms):
    """1 / |T_k(t)| at t = 2 / (u_c zeta) - 1, by |T_k| = |cosh(k arccosh t)|."""
    return 1 / abs(np.cosh(terms * np.arccosh(2 / (LARGEST * complex(zeta)) - 1)))


@pytest.mark.parametrize("terms", [1, 3, 4, 8])
@pytest.mark.parametrize("zeta", [1e3, 1e6, 1e7, 1e7 - 1e5j, 3e7])
def test_truncation_weights_reach_the_error_of_a_chebyshev_polynomial(zeta, terms):
    """Over the whole interval the relative error reaches its bound and does not exceed it."""
    u = LARGEST * np.linspace(1e-6, 1, 2001)
    exact = u / (1 - zeta * u)
    error = np.abs(approximation(zeta, u, terms) / exact - 1).max()
    bound = error_bound(zeta, terms)
    assert error < 1.001 * bound + 1e-11
    assert error > 0.9 * bound or bound < 1e-9
