"""Points and taps of a program: patterns without a file."""

from collections.abc import Sequence
from typing import TypeAlias

from controller.content.pattern import MAX_CONTENT_DURATION, Pattern, Transient
from model.errors import InputError

MAX_GIVEN = 500
"""Maximum number of points and taps together. OpenXR has the same limit; Android guarantees 16."""

Given: TypeAlias = Sequence[Sequence[float]]
"""`[time_s, intensity, sharpness]` of each, in order of time."""


def pattern_of_points(points: Given, taps: Given = ()) -> Pattern:
    """Return a pattern with straight lines between points, and with taps.

    Raises InputError, with the index of the first invalid point or tap.
    """
    count = len(points) + len(taps)
    if not 1 <= count <= MAX_GIVEN:
        raise InputError(f"points and taps must be 1 to {MAX_GIVEN} together, got {count}")
    _check_points("points", points)
    _check_points("taps", taps)
    intensity_curve = []
    sharpness_curve = []
    for time, intensity, sharpness in points:
        intensity_curve.append((time, intensity))
        sharpness_curve.append((time, sharpness))
    transients = tuple(Transient(*tap) for tap in taps)
    duration = max([time for time, _, _ in (*points[-1:], *taps[-1:])])
    return Pattern(duration, intensity_curve, sharpness_curve, transients)


def _check_points(name: str, points: Given) -> None:
    """Raise InputError for the first invalid point or tap."""
    last_time = 0.0
    for index, point in enumerate(points):
        place = f"{name}[{index}]"
        if len(point) != 3:
            raise InputError(
                f"{place} must be [time_s, intensity, sharpness], got {len(point)} values"
            )
        time, intensity, sharpness = point
        if not last_time <= time <= MAX_CONTENT_DURATION:
            limits = f"{last_time:g} to {MAX_CONTENT_DURATION:g}"
            raise InputError(f"{place} time_s must be {limits}, got {time:g}")
        for key, value in (("intensity", intensity), ("sharpness", sharpness)):
            if not 0 <= value <= 1:
                raise InputError(f"{place} {key} must be 0 to 1, got {value:g}")
        last_time = time
