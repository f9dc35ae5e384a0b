"""Functions of one direction, against integrals by adaptive quadrature."""

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.special import eval_legendre

from model.spectral.functions import EVEN, ODD, EdgedFunctions, _polynomials

LENGTH, DEGREE, DECAY = 0.3, 8, 2000.0


def _layer(x: float, parity: int) -> float:
    return np.exp(-DECAY * x) + parity * np.exp(-DECAY * (LENGTH - x))


@pytest.mark.parametrize("parity", [EVEN, ODD])
def test_slope_integrals_are_those_of_legendre_polynomials(parity):
    """The integrals of f'g and f'g' of normalised Legendre polynomials, by adaptive quadrature."""
    direction = EdgedFunctions(LENGTH, DEGREE, (DECAY,))
    degrees = range((1 - parity) // 2, DEGREE + 1, 2)
    others = range((1 + parity) // 2, DEGREE + 1, 2)

    def value(degree, x):
        return np.sqrt((2 * degree + 1) / LENGTH) * eval_legendre(degree, 2 * x / LENGTH - 1)

    def slope(degree, x):
        step = 1e-6 * LENGTH
        return (value(degree, x + step) - value(degree, x - step)) / (2 * step)

    products = [
        [quad(lambda x, i=i, j=j: slope(i, x) * value(j, x), 0, LENGTH)[0] for j in others]
        for i in degrees
    ]
    squares = [
        [quad(lambda x, i=i, j=j: slope(i, x) * slope(j, x), 0, LENGTH)[0] for j in degrees]
        for i in degrees
    ]
    found = direction.slope_products[parity][: len(degrees), : len(others)]
    np.testing.assert_allclose(found, products, rtol=1e-6, atol=1e-6 / LENGTH)
    found = direction.slope_squares[parity][: len(degrees), : len(degrees)]
    np.testing.assert_allclose(found, squares, rtol=1e-6, atol=1e-6 / LENGTH**2)


@pytest.mark.parametrize("parity", [EVEN, ODD])
def test_the_layer_is_orthogonal_to_the_polynomials_and_of_unit_norm(parity):
    """Its slope integral is that of the layer less its polynomials, by adaptive quadrature."""
    direction = EdgedFunctions(LENGTH, DEGREE, (DECAY,))
    degrees = range((1 - parity) // 2, DEGREE + 1, 2)
    near_edges = {"points": [3 / DECAY, LENGTH - 3 / DECAY], "limit": 400}

    def polynomial(degree, x):
        return np.sqrt((2 * degree + 1) / LENGTH) * eval_legendre(degree, 2 * x / LENGTH - 1)

    share = [
        quad(lambda x, n=n: polynomial(n, x) * _layer(x, parity), 0, LENGTH, **near_edges)[0]
        for n in degrees
    ]

    def rest(x):
        return _layer(x, parity) - sum(
            part * polynomial(n, x) for part, n in zip(share, degrees, strict=True)
        )

    def slope(x):
        step = 1e-3 / DECAY
        return (rest(x + step) - rest(x - step)) / (2 * step)

    norm = quad(lambda x: rest(x) ** 2, 0, LENGTH, **near_edges)[0]
    square = quad(lambda x: slope(x) ** 2, 0, LENGTH, **near_edges)[0] / norm
    assert direction.slope_squares[parity][-1, -1] == pytest.approx(square, rel=1e-5)


def test_a_layer_that_polynomials_resolve_is_left_out():
    """On a plate as thick as long, degree 24 has the layer's function already."""
    assert EdgedFunctions(LENGTH, 24, (3 / LENGTH,)).count(EVEN) == 13
    assert EdgedFunctions(LENGTH, 24, (DECAY,)).count(EVEN) == 14


def test_polynomials_are_normalised_legendre_polynomials_at_high_degree():
    """SciPy's, by recurrence, times sqrt((2 n + 1) / L), ends included."""
    x = np.concatenate([[0.0, 1e-9, LENGTH], np.random.default_rng(5).uniform(0, LENGTH, 100)])
    degrees = np.arange(61)
    expected = eval_legendre(degrees, 2 * x[:, None] / LENGTH - 1)
    expected *= np.sqrt((2 * degrees + 1) / LENGTH)
    found = _polynomials(x, LENGTH, 60)
    np.testing.assert_allclose(found, expected, atol=1e-11)
