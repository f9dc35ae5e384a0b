"""Points and taps that a program gives: time [s], intensity and sharpness of each."""

from collections.abc import Iterator, Sequence
from typing import TypeAlias

import numpy as np

from controller.content.pattern import MAX_DURATION, Pattern, Transient, along
from model.errors import InputError

MAX_GIVEN = 500
"""Most points and taps together: the bound of OpenXR; Android guarantees 16."""

Given: TypeAlias = Sequence[Sequence[float]]
"""`[time_s, intensity, sharpness]` of each, in order of time."""

_Row: TypeAlias = tuple[float, float, float]


def pattern_of_points(points: Given, taps: Given = ()) -> Pattern:
    """Return the pattern of points, between which straight lines last, and of taps beside them.

    Raises InputError, with the index of one, for what is none.
    """
    if not 1 <= (count := len(points) + len(taps)) <= MAX_GIVEN:
        raise InputError(f"points and taps must be 1 to {MAX_GIVEN} together, got {count}")
    lasting, short = [*_checked("points", points)], [*_checked("taps", taps)]
    return Pattern(
        max([time for time, _, _ in (*lasting[-1:], *short[-1:])]),
        tuple([(time, intensity) for time, intensity, _ in lasting]),
        tuple([(time, sharpness) for time, _, sharpness in lasting]),
        tuple([Transient(*each) for each in short]),
    )


def points_of(pattern: Pattern) -> tuple[list[_Row], list[_Row]]:
    """Return the points and taps of a pattern: at even distances where it has too many points.

    Raises InputError for too many taps.
    """
    taps = [(each.time, each.intensity, each.sharpness) for each in pattern.transients]
    room = MAX_GIVEN - len(taps)
    if room < (2 if pattern.intensity else 0):
        raise InputError(f"taps must be up to {MAX_GIVEN - 2}, got {len(taps)}; leave some out")
    if not pattern.intensity:
        return [], taps
    times, levels = np.array(pattern.intensity).T
    between = np.setdiff1d([time for time, _ in pattern.sharpness], times)
    between = between[(between > times[0]) & (between < times[-1])]
    moments = np.append(times, between)
    order = np.argsort(moments, kind="stable")
    levels = np.append(levels, along(pattern.intensity, between))[order]
    moments = moments[order]
    if len(moments) > room:
        moments = np.linspace(times[0], times[-1], room)
        levels = along(pattern.intensity, moments)
    sharpness = along(pattern.sharpness, moments)
    return [*zip(moments.tolist(), levels.tolist(), sharpness.tolist(), strict=True)], taps


def _checked(what: str, given: Given) -> Iterator[_Row]:
    """Yield each of what is given; raises InputError for what is none."""
    before = 0.0
    for index, each in enumerate(given):
        if len(each) != 3:
            raise InputError(
                f"{what}[{index}] must be [time_s, intensity, sharpness], got {len(each)} values"
            )
        time, intensity, sharpness = each
        if not before <= time <= MAX_DURATION:
            raise InputError(
                f"{what}[{index}] time_s must be {before:g} to {MAX_DURATION:g}, got {time:g}"
            )
        for name, value in (("intensity", intensity), ("sharpness", sharpness)):
            if not 0 <= value <= 1:
                raise InputError(f"{what}[{index}] {name} must be 0 to 1, got {value:g}")
        before = time
        yield time, intensity, sharpness
