"""From a sensor's coordinates to the plate's."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from controller.sources.touch import (
    Touch,
    TouchCalibration,
    fitted,
    turned,
)
from model.errors import InputError
from model.structure.plate import Material, Plate

ALUMINIUM = Material("aluminium", E=70e9, rho=2700, nu=0.33)
PLATE = Plate(length=0.4, width=0.2, thickness=1e-3, material=ALUMINIUM)


@pytest.mark.parametrize(
    ("degrees", "mirror", "top_left", "top_right"),
    [
        (0, None, (0, 0), (1, 0)),
        (90, None, (1, 0), (1, 1)),
        (180, None, (1, 1), (0, 1)),
        (270, None, (0, 1), (0, 0)),
        (0, "x", (1, 0), (0, 0)),
        (0, "y", (0, 1), (1, 1)),
        (90, "y", (1, 1), (1, 0)),
    ],
)
def test_turned_maps_corners(
    degrees: int, mirror: str | None, top_left: tuple[int, int], top_right: tuple[int, int]
) -> None:
    """The sensor's upper corners lie on the plate where those of a turned sheet of paper lie."""
    calibration = turned(degrees, mirror=mirror)
    for corner, apply in (((0, 0), top_left), ((1, 0), top_right)):
        placed = calibration.apply(Touch(1, *corner))
        assert (placed.x, placed.y) == pytest.approx(apply)


def test_fitted_by_hand() -> None:
    """A sensor 5 cm wider than the plate on each side, touched at three corners of the plate.

    The plate's middle is the sensor's middle, and its north-west corner is where it was touched.
    """
    touched = [(0.1, 0.1), (0.9, 0.1), (0.1, 0.9)]
    calibration = fitted(touched, [(0, 0.2), (0.4, 0.2), (0, 0)], PLATE)
    middle = calibration.apply(Touch(1, 0.5, 0.5))
    corner = calibration.apply(Touch(1, 0.1, 0.1))
    assert (middle.x, middle.y) == pytest.approx((0.5, 0.5))
    assert (corner.x, corner.y) == pytest.approx((0, 0), abs=1e-12)


@given(
    matrix=st.tuples(*[st.floats(-2, 2) for _ in range(6)]).filter(
        lambda m: abs(m[0] * m[4] - m[1] * m[3]) > 0.1
    )
)
def test_fitted_recovers_any_matrix(matrix: tuple[float, ...]) -> None:
    """Four points placed by any matrix give that matrix back."""
    a, b, c, d, e, f = matrix
    truth = TouchCalibration(((a, b, c), (d, e, f)))
    touched = [(0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (1.0, 1.0)]
    placed = [truth.apply(Touch(1, *point)) for point in touched]
    positions = [(0.4 * touch.x, 0.2 * (1 - touch.y)) for touch in placed]
    found = fitted(touched, positions, PLATE)
    assert [*found.matrix[0], *found.matrix[1]] == pytest.approx(matrix, abs=1e-9)


def test_fitted_refuses_a_large_residual() -> None:
    """One of four corners was touched 4 cm off; the error has the residual."""
    touched = [(0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (1.0, 1.0)]
    with pytest.raises(InputError, match=r"point \d .*10\.0 mm"):
        # A quarter of the error stays at every corner of a parallelogram.
        fitted(touched, [(0, 0.2), (0.4, 0.2), (0, 0), (0.36, 0)], PLATE)


@pytest.mark.parametrize(
    ("touched", "positions"),
    [
        ([(0, 0), (0.5, 0.5), (1, 1)], [(0, 0), (0.4, 0), (0, 0.2)]),
        ([(0, 0), (1, 0), (0, 1)], [(0, 0), (0.2, 0.1), (0.4, 0.2)]),
        ([(0, 0), (1, 0), (0, 1)], [(0, 0), (0, 0), (0, 0)]),
    ],
)
def test_fitted_refuses_points_on_a_line(
    touched: list[tuple[float, float]], positions: list[tuple[float, float]]
) -> None:
    """On the sensor or on the plate: every finger would be on that line."""
    with pytest.raises(InputError, match="three corners"):
        fitted(touched, positions, PLATE)
