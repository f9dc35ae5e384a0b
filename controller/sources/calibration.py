"""From a sensor's coordinates to the plate's: turned, mirrored, shifted, scaled or sheared.

The matrix is that of libinput's LIBINPUT_CALIBRATION_MATRIX: x' = a x + b y + c, y' = d x + e y + f
on coordinates 0..1 from the top left corner.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np

from controller.sources.touch import Touch, TouchFrame, TouchSource
from model.errors import InputError
from model.structure.plate import Plate

Row: TypeAlias = tuple[float, float, float]
Point: TypeAlias = tuple[float, float]

# A panel that is off by more than this [m] after the fit was not touched where the points say; a
# fingertip's own radius is 6.5 mm.
WORST_FIT = 0.005
# Below this a matrix folds the sensor onto a line.
_LEAST_AREA = 1e-3

_TURNS: dict[int, tuple[Row, Row]] = {
    0: ((1, 0, 0), (0, 1, 0)),
    90: ((0, -1, 1), (1, 0, 0)),
    180: ((-1, 0, 1), (0, -1, 1)),
    270: ((0, 1, 0), (-1, 0, 1)),
}


@dataclass(frozen=True)
class TouchCalibration:
    """Where on the plate a touch of the sensor lies; raises InputError on a matrix that folds."""

    matrix: tuple[Row, Row] = _TURNS[0]

    def __post_init__(self) -> None:
        numbers = [number for row in self.matrix for number in row]
        (a, b, _), (d, e, _) = self.matrix
        if not all(map(math.isfinite, numbers)) or abs(a * e - b * d) < _LEAST_AREA:
            raise InputError(
                f"the touch calibration {self.matrix} folds the sensor onto a line or is not "
                "finite; expected two rows of three numbers, (1, 0, 0) and (0, 1, 0) for a sensor "
                "that fits the plate"
            )

    def place(self, touch: Touch) -> Touch:
        """The touch in the plate's coordinates, 0..1 across it; not finite stays so."""
        (a, b, c), (d, e, f) = self.matrix
        return replace(
            touch,
            x=a * touch.x + b * touch.y + c,
            y=d * touch.x + e * touch.y + f,
        )


def turned(degrees: int = 0, *, mirror: str | None = None) -> TouchCalibration:
    """For a sensor that is mounted turned clockwise by 0, 90, 180 or 270 degrees.

    mirror: "x" where left and right are exchanged after that, "y" where top and bottom are.
    Raises InputError on anything else.
    """
    if degrees not in _TURNS or mirror not in (None, "x", "y"):
        raise InputError(
            f"a touch sensor is turned by {degrees} and mirrored {mirror}: expected 0, 90, 180 or "
            "270 degrees, and x, y or nothing to mirror"
        )
    x_row, y_row = _TURNS[degrees]
    if mirror == "x":
        x_row = _reversed(x_row)
    if mirror == "y":
        y_row = _reversed(y_row)
    return TouchCalibration((x_row, y_row))


def fitted(touched: Sequence[Point], places: Sequence[Point], plate: Plate) -> TouchCalibration:
    """From at least three points: what the sensor said (0..1) and where on the plate [m] that was.

    Least squares; places count from the plate's south-west corner, y upwards. Raises InputError if
    the points lie on a line, or are off by more than 5 mm after the fit.
    """
    if len(touched) != len(places) or len(touched) < 3:
        raise InputError(
            f"{len(touched)} touches for {len(places)} places: a touch calibration needs at least "
            "three points, each with a touch and a place, best near three corners"
        )
    wanted = np.array([(x / plate.length, 1 - y / plate.width) for x, y in places])
    known = np.column_stack((np.array(touched, dtype=float), np.ones(len(touched))))
    if not (np.isfinite(known).all() and np.isfinite(wanted).all()):
        raise InputError("a point of the touch calibration is not finite; touch it again")
    if np.linalg.matrix_rank(known, tol=0.05) < 3:
        raise InputError(
            "the points of the touch calibration lie on a line; touch three corners of the plate"
        )
    solution = np.linalg.lstsq(known, wanted, rcond=None)[0]
    error = (known @ solution - wanted) * (plate.length, plate.width)
    distances = np.hypot(error[:, 0], error[:, 1])
    worst = int(np.argmax(distances))
    if distances[worst] > WORST_FIT:
        raise InputError(
            f"the touch calibration fits point {worst + 1} only to {distances[worst] * 1e3:.1f} mm "
            f"(at most {WORST_FIT * 1e3:g} mm); look for a point that was touched elsewhere, or a "
            "panel that is curved"
        )
    (a, d), (b, e), (c, f) = solution.tolist()
    return TouchCalibration(((a, b, c), (d, e, f)))


class CalibratedSource(TouchSource):
    """A touch source in the plate's coordinates."""

    def __init__(self, source: TouchSource, calibration: TouchCalibration) -> None:
        self._source = source
        self._calibration = calibration

    async def run(self, deliver: Callable[[TouchFrame], None]) -> None:
        """Run the source and deliver its frames with every touch in its place."""
        place = self._calibration.place

        def placed(frame: TouchFrame) -> None:
            deliver(replace(frame, touches=tuple(map(place, frame.touches))))

        await self._source.run(placed)


def _reversed(row: Row) -> Row:
    """The row of 1 - x' for the row of x'."""
    a, b, c = row
    return (-a, -b, 1 - c)
