"""Points and taps of a program: patterns without a file."""

from collections.abc import Sequence
from typing import TypeAlias

import numpy as np

from controller.content.pattern import (
    MAX_CONTENT_DURATION,
    Curve,
    Pattern,
    Transient,
    curve_at,
)
from model.arrays import FloatArray
from model.errors import InputError

MAX_GIVEN = 500
"""Maximum number of points and taps together, same as in OpenXR; Android guarantees 16."""

Given: TypeAlias = Sequence[Sequence[float]]
"""`[time_s, intensity, sharpness]` of each, in order of time."""

_Point: TypeAlias = tuple[float, float, float]
"""Time [s], intensity and sharpness."""


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


def points_of(pattern: Pattern) -> tuple[list[_Point], list[_Point]]:
    """Return the points and taps of a pattern, evenly spaced points if it has too many.

    Raises InputError for too many taps.
    """
    taps = [(tap.time, tap.intensity, tap.sharpness) for tap in pattern.transients]
    max_points = MAX_GIVEN - len(taps)
    if max_points < (2 if pattern.intensity else 0):
        raise InputError(f"taps must be up to {MAX_GIVEN - 2}, got {len(taps)}; leave some out")
    if not pattern.intensity:
        return [], taps
    times, levels = _joint_points(pattern.intensity, pattern.sharpness)
    if len(times) > max_points:
        times = np.linspace(times[0], times[-1], max_points)
        levels = curve_at(pattern.intensity, times)
    sharpness = curve_at(pattern.sharpness, times)
    points = zip(times.tolist(), levels.tolist(), sharpness.tolist(), strict=True)
    return list(points), taps


def _joint_points(intensity: Curve, sharpness: Curve) -> tuple[FloatArray, FloatArray]:
    """Return times (n,) [s] with all points of both curves, and the intensity there."""
    times, levels = np.array(intensity).T
    added = np.setdiff1d([time for time, _ in sharpness], times)
    added = added[(added > times[0]) & (added < times[-1])]
    all_times = np.append(times, added)
    all_levels = np.append(levels, curve_at(intensity, added))
    order = np.argsort(all_times, kind="stable")
    return all_times[order], all_levels[order]
