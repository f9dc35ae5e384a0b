"""Calibration of touch sensors: an affine map from sensor to plate coordinates.

x' = a x + b y + c, y' = d x + e y + f, with coordinates 0..1 from the top left corner.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, TypeAlias

from controller.sources.touch import Touch
from model.errors import InputError

if TYPE_CHECKING:  # numpy is slow to import
    from model.structure.plate import Plate

_Row: TypeAlias = tuple[float, float, float]
_Point: TypeAlias = tuple[float, float]

MAX_RESIDUAL = 0.005
"""Largest residual [m] of a correctly touched point: less than a fingertip's radius of 6.5 mm."""

_FITTED_POINTS = 3  # points that an affine map fits exactly

_MIN_DETERMINANT = 1e-3  # below it, the points on the plate are almost collinear

_ROTATIONS: dict[int, tuple[_Row, _Row]] = {
    0: ((1, 0, 0), (0, 1, 0)),
    90: ((0, -1, 1), (1, 0, 0)),
    180: ((-1, 0, 1), (0, -1, 1)),
    270: ((0, 1, 0), (-1, 0, 1)),
}


@dataclass(frozen=True)
class TouchCalibration:
    """Map from sensor to plate: the rows for x' and y'."""

    matrix: tuple[_Row, _Row] = _ROTATIONS[0]
    residuals: tuple[float, ...] = ()
    """Distance [m] of each touched point from its mapped position; empty without points."""

    def apply(self, touch: Touch) -> Touch:
        """Map a touch to coordinates 0..1 across the plate; NaN stays NaN."""
        (a, b, c), (d, e, f) = self.matrix
        x = a * touch.x + b * touch.y + c
        y = d * touch.x + e * touch.y + f
        size = touch.size
        if size is not None:
            width, height = size
            size = math.hypot(a * width, b * height), math.hypot(d * width, e * height)
        return replace(touch, x=x, y=y, size=size)

    def touch_position(self, default: float) -> float:
        """Return the RMS distance [m] of touches from their mapped positions.

        From the residuals. The three points that any map fits count with a default [m] instead, so
        three points, or none, leave the default.
        """
        if not self.residuals:
            return default
        squares = sum(residual**2 for residual in self.residuals)
        return math.sqrt((squares + _FITTED_POINTS * default**2) / len(self.residuals))


ALIGNED = TouchCalibration()
"""Calibration of a sensor aligned with the plate."""


def turned(degrees: int = 0, *, mirror: str | None = None) -> TouchCalibration:
    """Return the calibration of a sensor mounted turned clockwise by 0, 90, 180 or 270 degrees.

    mirror: "x" to swap left and right after that, "y" for top and bottom.
    """
    x_row, y_row = _ROTATIONS[degrees]
    if mirror == "x":
        x_row = _mirrored(x_row)
    elif mirror == "y":
        y_row = _mirrored(y_row)
    return TouchCalibration((x_row, y_row))


def _mirrored(row: _Row) -> _Row:
    a, b, c = row
    return -a, -b, 1 - c


def fit_touch_calibration(
    touched: Sequence[_Point], positions: Sequence[_Point], plate: "Plate"
) -> TouchCalibration:
    """Fit a calibration by least squares to at least three points.

    touched: sensor coordinates 0..1; positions: on the plate [m] from its south-west corner, y
    upwards. Raises InputError for points on a line or residuals above 5 mm.
    """
    import numpy as np  # a source without a calibration does not need it

    expected = np.array([(x / plate.length, 1 - y / plate.width) for x, y in positions])
    measured = np.column_stack((np.array(touched, dtype=float), np.ones(len(touched))))
    solution = np.linalg.lstsq(measured, expected, rcond=None)[0]
    is_collinear = np.linalg.matrix_rank(measured, tol=0.05) < 3
    determinant = np.linalg.det(solution[:2])
    if is_collinear or abs(determinant) < _MIN_DETERMINANT:
        raise InputError(
            "points of the touch calibration must not lie on a line; touch three corners"
        )
    error = (measured @ solution - expected) * (plate.length, plate.width)
    residuals = np.hypot(error[:, 0], error[:, 1])
    worst = int(np.argmax(residuals))
    residual = residuals[worst]
    if residual > MAX_RESIDUAL:
        raise InputError(
            f"residual of touch calibration point {worst + 1} must be at most "
            f"{MAX_RESIDUAL * 1e3:g} mm, got {residual * 1e3:.1f} mm; check its position "
            "and whether the panel is curved"
        )
    (a, d), (b, e), (c, f) = solution.tolist()
    return TouchCalibration(((a, b, c), (d, e, f)), tuple(residuals.tolist()))
