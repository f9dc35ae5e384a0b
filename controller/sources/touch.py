"""Touch sources: frames of all touches at one moment, by the scheme of a URL, mapped to the plate.

A calibration is an affine map from coordinates of a sensor to those of the plate: x' = a x + b y +
c, y' = d x + e y + f on coordinates 0..1 from the top left corner.
"""

import logging
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeAlias
from urllib.parse import parse_qsl

from controller.sources.reject_counter import RejectCounter
from model.errors import InputError
from model.structure.plate import Plate
from registry.plugins import PluginRegistry


@dataclass(frozen=True, slots=True)
class Touch:
    """One finger as reported by its source.

    id: constant from down to up; x, y: 0..1 across the sensor from its top left corner, y downwards
    (the convention of TUIO and most panels). Not validated: may be NaN. load: on the plate relative
    to the rig's fingertip, not bounded (`contacts`); None where nothing is reported.
    """

    id: int
    x: float
    y: float
    load: float | None = None


@dataclass(frozen=True, slots=True)
class TouchFrame:
    """All touches of a source at one moment; a touch missing from it has been lifted.

    time: of arrival, by the event loop's clock [s]. timeout [s]: time without a frame of this
    source after which its touches are lifted; None: CONTACT_TIMEOUT. origin: the host or client,
    which may have several sources; None: the source itself.
    """

    source: str
    time: float
    touches: tuple[Touch, ...]
    timeout: float | None = None
    origin: str | None = None


class TouchSource(ABC):
    """Source of touch frames, repeated at least every 100 ms while there are touches.

    A source that cannot repeat them states a longer timeout in its frames.
    """

    @cached_property
    def rejects(self) -> RejectCounter:
        """Counter of malformed input; a daemon sets its own, before `run`."""
        return RejectCounter(logging.getLogger(__name__))

    @property
    def problem(self) -> str | None:
        """Why no touches come although it runs, and what to do; None if they may."""
        return None

    @abstractmethod
    async def run(self, deliver: Callable[[TouchFrame], None]) -> None:
        """Deliver frames until cancelled or, for a recording, until its end.

        Malformed input must be counted in `rejects`, not raised; that it cannot be opened, or is
        lost, is raised as InputError.
        """


def number_option(options: str, name: str, *, default: float) -> float:
    """Return the number of the only option that there may be; NaN for anything else."""
    given = dict(parse_qsl(options, keep_blank_values=True))
    text = given.pop(name, str(default))
    try:
        return math.nan if given else float(text)
    except ValueError:
        return math.nan


_SOURCES: PluginRegistry[Callable[[str], TouchSource]] = PluginRegistry(
    "touch source",
    "era_haptics.touch_sources",
    TouchSource,
    error=InputError,
    own={
        "evdev": "controller.sources.evdev:EvdevSource",
        "tuio": "controller.sources.tuio:TuioSource",
    },
    ending=":",
    example="tuio:127.0.0.1:3333",
)


def open_source(url: str) -> TouchSource:
    """Create the touch source of a URL such as `tuio:127.0.0.1:3333` or `evdev:/dev/input/event5`.

    Raises InputError for an unknown scheme, a failing plug-in or a URL that it refuses.
    """
    return _SOURCES.make(url)


Row: TypeAlias = tuple[float, float, float]
Point: TypeAlias = tuple[float, float]

# m; with a larger residual a point was not touched where it should be (a fingertip's radius is
# 6.5 mm).
MAX_RESIDUAL = 0.005
# Below this determinant the plate's points lie on a line for practical purposes.
_MIN_DETERMINANT = 1e-3

_ROTATIONS: dict[int, tuple[Row, Row]] = {
    0: ((1, 0, 0), (0, 1, 0)),
    90: ((0, -1, 1), (1, 0, 0)),
    180: ((-1, 0, 1), (0, -1, 1)),
    270: ((0, 1, 0), (-1, 0, 1)),
}


@dataclass(frozen=True)
class TouchCalibration:
    """Map from sensor to plate: the rows of x' and y'."""

    matrix: tuple[Row, Row] = _ROTATIONS[0]

    def apply(self, touch: Touch) -> Touch:
        """Map a touch to coordinates 0..1 across the plate; NaN stays NaN."""
        (a, b, c), (d, e, f) = self.matrix
        return replace(
            touch,
            x=a * touch.x + b * touch.y + c,
            y=d * touch.x + e * touch.y + f,
        )


ALIGNED = TouchCalibration()


def turned(degrees: int = 0, *, mirror: str | None = None) -> TouchCalibration:
    """Return the calibration of a sensor mounted turned clockwise by 0, 90, 180 or 270 degrees.

    mirror: "x" to swap left and right after that, "y" for top and bottom.
    """
    x_row, y_row = _ROTATIONS[degrees]
    if mirror == "x":
        x_row = _reversed(x_row)
    if mirror == "y":
        y_row = _reversed(y_row)
    return TouchCalibration((x_row, y_row))


def fitted(touched: Sequence[Point], positions: Sequence[Point], plate: Plate) -> TouchCalibration:
    """Fit a calibration by least squares to at least three points.

    touched: sensor coordinates 0..1; positions: on the plate [m] from its south-west corner, y
    upwards. Raises InputError for points on a line or residuals above 5 mm.
    """
    import numpy as np  # a source without a calibration does not need it

    expected = np.array([(x / plate.length, 1 - y / plate.width) for x, y in positions])
    measured = np.column_stack((np.array(touched, dtype=float), np.ones(len(touched))))
    solution = np.linalg.lstsq(measured, expected, rcond=None)[0]
    is_invertible = abs(np.linalg.det(solution[:2])) >= _MIN_DETERMINANT
    if np.linalg.matrix_rank(measured, tol=0.05) < 3 or not is_invertible:
        raise InputError(
            "points of the touch calibration must not lie on a line; touch three corners"
        )
    error = (measured @ solution - expected) * (plate.length, plate.width)
    distances = np.hypot(error[:, 0], error[:, 1])
    worst = int(np.argmax(distances))
    if distances[worst] > MAX_RESIDUAL:
        raise InputError(
            f"residual of touch calibration point {worst + 1} must be at most "
            f"{MAX_RESIDUAL * 1e3:g} mm, got {distances[worst] * 1e3:.1f} mm; check where it was "
            "touched, and whether the panel is curved"
        )
    (a, d), (b, e), (c, f) = solution.tolist()
    return TouchCalibration(((a, b, c), (d, e, f)))


def _reversed(row: Row) -> Row:
    """Return the row of 1 - x' for the row of x'."""
    a, b, c = row
    return (-a, -b, 1 - c)
