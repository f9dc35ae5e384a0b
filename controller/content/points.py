"""Points and taps of a program: patterns without a file."""

from collections.abc import Sequence
from typing import TypeAlias

from controller.content.pattern import Pattern, Transient, misfit
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
    for index, point in enumerate((*points, *taps)):
        if len(point) != 3:
            raise InputError(
                f"points and taps must be [time_s, intensity, sharpness], got {len(point)} values "
                f"in entry {index} of them"
            )
    intensity_curve = []
    sharpness_curve = []
    for time, intensity, sharpness in points:
        intensity_curve.append((time, intensity))
        sharpness_curve.append((time, sharpness))
    transients = tuple(Transient(*tap) for tap in taps)
    duration = max([time for time, _, _ in (*points[-1:], *taps[-1:])])
    pattern = Pattern(duration, intensity_curve, sharpness_curve, transients)
    problem = misfit(pattern)
    if problem:
        raise InputError(problem)
    return pattern
