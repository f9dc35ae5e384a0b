"""Points that a program gives: time [s], intensity and sharpness of each."""

from collections.abc import Sequence

from controller.content.format import MAX_DURATION
from controller.content.pattern import Pattern
from model.errors import InputError

MAX_GIVEN = 500
"""Most points, the bound of OpenXR; Android guarantees 16."""


def pattern_of_points(points: Sequence[Sequence[float]]) -> Pattern:
    """Return the pattern of `[time_s, intensity, sharpness]` in order of time.

    Raises InputError, with the index of a point, for one that is none.
    """
    if not 1 <= len(points) <= MAX_GIVEN:
        raise InputError(f"points must be 1 to {MAX_GIVEN}, got {len(points)}")
    before = 0.0
    for index, point in enumerate(points):
        if len(point) != 3:
            raise InputError(
                f"points[{index}] must be [time_s, intensity, sharpness], got {len(point)} values"
            )
        time, intensity, sharpness = point
        if not before <= time <= MAX_DURATION:
            raise InputError(
                f"points[{index}] time_s must be {before:g} to {MAX_DURATION:g}, got {time:g}"
            )
        for name, value in (("intensity", intensity), ("sharpness", sharpness)):
            if not 0 <= value <= 1:
                raise InputError(f"points[{index}] {name} must be 0 to 1, got {value:g}")
        before = time
    return Pattern(
        before,
        tuple((time, intensity) for time, intensity, _ in points),
        tuple((time, sharpness) for time, _, sharpness in points),
    )
