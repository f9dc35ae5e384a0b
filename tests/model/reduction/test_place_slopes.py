"""Derivatives of fields by places, against those of functions that are known."""

import numpy as np

from model.arrays import FloatArray
from model.reduction.place_slopes import place_slopes

SIDES = np.array([0.3, 0.2])
WAVES = np.array([[20.0, 0.0], [35.0, -60.0], [0.0, 90.0]])  # rad/m


def test_slopes_are_those_of_waves() -> None:
    """Inside, beside edges and at corners, to 2e-6 of the wave number, from points on the plate."""
    places = np.array([[0.1, 0.05], [0.0, 0.12], [0.3, 0.2], [1e-7, 0.2], [0.12, 0.2 - 1e-7]])
    places = np.column_stack([places, np.full(len(places), 0.01)])

    def field(at: FloatArray) -> FloatArray:
        assert ((at[:, :2] >= 0) & (at[:, :2] <= SIDES)).all()
        assert (at[:, 2] == 0.01).all()
        return np.asarray(np.sin(at[:, :2] @ WAVES.T))

    exact = np.cos(places[:, :2] @ WAVES.T)[:, None] * WAVES.T
    np.testing.assert_allclose(place_slopes(field, places, SIDES), exact, atol=2e-6 * 90)
