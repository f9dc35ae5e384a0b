"""Points and weights over a fingertip's disc, against exact integrals."""

import math

import numpy as np
import pytest
from scipy.integrate import dblquad

from model.finger import (
    FINE_POINTS,
    FINGERTIP_RADIUS,
    FIVE_POINTS,
    DiscRule,
    fingertips_on,
)
from model.structure.plate import Material, Plate

PLATE = Plate(0.3, 0.2, 0.0015, Material("any", E=70e9, rho=2700.0, nu=0.33))


def disc_mean(i: int, j: int) -> float:
    """Mean of x^i y^j over the unit disc, by the beta function; zero for odd powers."""
    if i % 2 or j % 2:
        return 0.0
    beta = math.gamma((i + 1) / 2) * math.gamma((j + 1) / 2) / math.gamma((i + j) / 2 + 1)
    return beta / math.pi * 2 / (i + j + 2)


@pytest.mark.parametrize(("rule", "degree"), [(FIVE_POINTS, 3), (FINE_POINTS, 7)])
def test_rules_integrate_polynomials_up_to_their_degree(rule: DiscRule, degree: int) -> None:
    """Every monomial up to the degree has the exact mean over the disc, one beyond has not."""
    x, y = rule.points.T
    for i in range(degree + 1):
        for j in range(degree + 1 - i):
            assert rule.weights @ (x**i * y**j) == pytest.approx(disc_mean(i, j), abs=1e-14)
    beyond = degree + 1
    assert abs(rule.weights @ x**beyond - disc_mean(beyond, 0)) > 1e-3


@pytest.mark.parametrize("rule", [FIVE_POINTS, FINE_POINTS])
@pytest.mark.parametrize(
    ("low", "high"),
    [((0, -2), (2, 2)), ((0, 0), (2, 2)), ((-2, -2), (0.3, 0.8)), ((-0.31, -2), (2, 2))],
)
def test_cut_discs_keep_the_mean_of_linear_functions(
    rule: DiscRule, low: tuple[float, float], high: tuple[float, float]
) -> None:
    """At an edge and at corners the mean of a linear function is that over what remains."""

    def integral(power_x: int, power_y: int) -> float:
        left, right = max(low[0], -1), min(high[0], 1)
        value, _ = dblquad(
            lambda y, x: x**power_x * y**power_y,
            left,
            right,
            lambda x: max(low[1], -math.sqrt(1 - x * x)),
            lambda x: min(high[1], math.sqrt(1 - x * x)),
            epsabs=1e-7,
        )
        return value

    points, weights = (each[0] for each in rule.cut(np.array([low]), np.array([high])))
    expected = np.array([integral(1, 0), integral(0, 1)]) / integral(0, 0)
    assert weights.min() >= 0
    assert weights.sum() == pytest.approx(1)
    np.testing.assert_allclose(weights @ points, expected, atol=1e-5)


def test_fingertips_on_keeps_every_point_on_the_plate_and_under_the_finger() -> None:
    """At a hundred places, corners among them, no point is off the plate or the fingertip."""
    rng = np.random.default_rng(1)
    size = np.array([PLATE.length, PLATE.width])
    centres = np.concatenate([rng.uniform(0, size, (100, 2)), [[0, 0], size, [0, size[1]]]])
    points, weights = fingertips_on(centres, length=PLATE.length, width=PLATE.width)
    assert ((points >= -1e-15) & (points <= size + 1e-15)).all()
    assert np.linalg.norm(points - centres[:, None], axis=2).max() <= FINGERTIP_RADIUS + 1e-12
    np.testing.assert_allclose(weights.sum(axis=1), 1)
