"""The bounded quadratic form against a general optimiser."""

import numpy as np
import pytest
from scipy.optimize import minimize

from model.transients.knots import bounded_solution


def random_form(seed: int, n: int):
    """A (n, n) Hermitian positive definite and b (n,) for which bounds of 1 matter."""
    rng = np.random.default_rng(seed)
    rows = rng.standard_normal((2 * n, n)) + 1j * rng.standard_normal((2 * n, n))
    A = rows.conj().T @ rows
    return A, 3 * A @ (rng.standard_normal(n) + 1j * rng.standard_normal(n)) / np.sqrt(n)


def value(A, b, x):
    """What is minimised."""
    return float((x.conj() @ A @ x - 2 * b.conj() @ x).real)


@pytest.mark.parametrize("seed", range(5))
def test_bounded_solution_equals_a_general_optimiser(seed):
    """No bound is exceeded, and the value is that of SLSQP within 1 % of what is to be gained."""
    A, b = random_form(seed, 6)
    found = bounded_solution(A, b, np.ones(6))
    general = minimize(
        lambda z: value(A, b, z[:6] + 1j * z[6:]),
        np.zeros(12),
        method="SLSQP",
        constraints={"type": "ineq", "fun": lambda z: 1 - z[:6] ** 2 - z[6:] ** 2},
        options={"maxiter": 500, "ftol": 1e-12},
    )
    assert np.abs(np.linalg.solve(A, b)).max() > 1  # the bounds are in the way
    assert np.abs(found).max() <= 1
    assert value(A, b, found) <= 0.99 * general.fun


def test_bounded_solution_is_unbounded_when_bounds_are_inactive():
    """Where the free solution keeps the bounds, it is the answer."""
    A, b = random_form(9, 7)
    free = np.linalg.solve(A, b)
    np.testing.assert_allclose(bounded_solution(A, b, 1.01 * np.abs(free)), free, rtol=1e-9)
