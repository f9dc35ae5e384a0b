"""Points and taps of a content file, for `play` of the daemon's API."""

from typing import TypeAlias

import numpy as np

from controller.content.pattern import Curve, Pattern, curve_at
from controller.content.points import MAX_GIVEN
from model.arrays import FloatArray
from model.errors import InputError

_Point: TypeAlias = tuple[float, float, float]
"""Time [s], intensity and sharpness."""


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
