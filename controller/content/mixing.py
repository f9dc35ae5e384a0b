"""Mixing: simultaneous continuous vibrations of a file, as one intensity and one sharpness curve.

A curve between two neighboring knots is an array (2, n): its values just inside both ends of each
interval, so that it can have a step at every knot.
"""

from typing import TypeAlias

import numpy as np

from controller.content.pattern import Curve
from controller.content.reading import refusal
from model.arrays import FloatArray, IntArray

Segment: TypeAlias = tuple[float, float, float, float, float, float]
"""Start and end [s], intensity at both, sharpness at both; straight lines between."""

_STEP = 0.005  # s; within it, products and sums of straight lines count as straight
_DIGITS = 9  # times are rounded to nanoseconds, so that none are almost equal
_MAX_OVERLAP = 1_000_000  # pieces of segments
_SAME = 1e-12  # difference of equal values


def mixed(
    source: str,
    segments: list[Segment],
    *,
    factor: Curve = ((0.0, 1.0),),
    addend: Curve = ((0.0, 0.0),),
) -> tuple[Curve, Curve]:
    """Return intensity and sharpness of segments that may overlap.

    Intensities add as powers, up to 1; the strongest segment determines the sharpness. factor,
    addend: applied to all intensities and sharpnesses over time. source: file name, for errors.
    """
    rows = np.array(segments).reshape(-1, 6)
    limits = rows[:, :2].round(_DIGITS)
    has_duration = limits[:, 1] > limits[:, 0]
    if not has_duration.any():
        return (), ()
    rows = rows[has_duration]
    starts, ends = limits[has_duration].T
    curve_times = [time for curve in (factor, addend) for time, _ in curve]
    knots = _knots(starts, ends, curve_times)
    segment, interval = _pieces(source, starts, ends, knots)
    piece_limits = np.stack([knots[interval], knots[interval + 1]])
    durations = ends - starts
    shares = (piece_limits - starts[segment]) / durations[segment]
    levels = _along(rows[segment, 2:4], shares)
    sharpnesses = _along(rows[segment, 4:6], shares)
    count = len(knots) - 1
    intensity = _added(levels, interval, count)
    sharpness = _strongest(sharpnesses, levels, interval, count)
    intensity *= stretches_between(factor, knots)
    sharpness += stretches_between(addend, knots)
    return _curve(knots, intensity), _curve(knots, sharpness)


def _knots(starts: FloatArray, ends: FloatArray, curve_times: list[float]) -> FloatArray:
    """Return the times [s] between which all curves count as straight, in order."""
    first = starts.min()
    last = ends.max()
    grid = np.arange(first, last, _STEP)
    inner = np.round([*grid, *curve_times], _DIGITS)
    knots = np.unique(np.concatenate([starts, ends, inner]))
    return np.asarray(knots[(knots >= first) & (knots <= last)])


def _pieces(
    source: str, starts: FloatArray, ends: FloatArray, knots: FloatArray
) -> tuple[IntArray, IntArray]:
    """Cut segments at the knots; return the segment and the interval of each piece (p,)."""
    first = np.searchsorted(knots, starts)
    end = np.searchsorted(knots, ends)
    counts = end - first
    total = int(counts.sum())
    if total > _MAX_OVERLAP:
        raise refusal(source, "has too many events that overlap; shorten them")
    segment = np.repeat(np.arange(len(starts)), counts)
    first_pieces = np.cumsum(counts) - counts
    shifts = first - first_pieces
    interval = np.arange(total) + shifts[segment]
    return segment, interval


def _along(ends: FloatArray, shares: FloatArray) -> FloatArray:
    """Interpolate between the values (p, 2) at both ends of lines; shares (2, p): 0 to 1."""
    first, last = ends.T
    return np.asarray(first + shares * (last - first))


def _added(levels: FloatArray, interval: IntArray, count: int) -> FloatArray:
    """Add the levels (2, p) of pieces as powers; return the sums (2, count) by interval."""
    powers = [np.bincount(interval, end_levels**2, minlength=count) for end_levels in levels]
    return np.sqrt(np.stack(powers))


def _strongest(
    sharpnesses: FloatArray, levels: FloatArray, interval: IntArray, count: int
) -> FloatArray:
    """Return the sharpness (2, count) of the strongest piece by interval; NaN without pieces."""
    order = np.argsort(levels.sum(axis=0), kind="stable")
    sharpness = np.full((2, count), np.nan)
    # Of equal indices the last one is kept.
    sharpness[:, interval[order]] = sharpnesses[:, order]
    return sharpness


def stretches_between(curve: Curve, knots: FloatArray) -> FloatArray:
    """Return a curve (2, n) just inside both ends of each interval between knots."""
    times, values = np.array(curve).T
    times = times.round(_DIGITS)
    starts = knots[:-1]
    widths = np.diff(knots)
    early = np.interp(starts + 0.25 * widths, times, values)
    late = np.interp(starts + 0.75 * widths, times, values)
    at_start = 1.5 * early - 0.5 * late
    at_end = 1.5 * late - 0.5 * early
    return np.stack([at_start, at_end])


def _curve(knots: FloatArray, values: FloatArray) -> Curve:
    """Return the points of a curve, limited to 0..1; NaN for intervals without one."""
    times = np.stack([knots[:-1], knots[1:]], axis=1).ravel()
    course = np.clip(values, 0, 1).T.ravel()
    is_defined = ~np.isnan(course)
    return thinned_curve(times[is_defined], course[is_defined])


def thinned_curve(times: FloatArray, values: FloatArray) -> Curve:
    """Return a curve without points that repeat another or are on the line between neighbors."""
    has_new_time = np.diff(times) > 0
    has_new_value = abs(np.diff(values)) > _SAME
    is_new = np.ones(len(times), bool)
    is_new[1:] = has_new_time | has_new_value
    times = times[is_new]
    values = values[is_new]
    is_kept = np.ones(len(times), bool)
    if len(times) > 2:
        is_kept[1:-1] = _is_corner(times, values)
    points = zip(times[is_kept].tolist(), values[is_kept].tolist(), strict=True)
    return tuple(points)


def _is_corner(times: FloatArray, values: FloatArray) -> FloatArray:
    """Whether each inner point (n - 2,) is at a step, or off the line between its neighbors."""
    gaps = np.diff(times)
    gap_ahead = gaps[:-1]
    gap_behind = gaps[1:]
    is_step = (gap_ahead == 0) | (gap_behind == 0)
    width = times[2:] - times[:-2]
    share = np.divide(gap_ahead, width, out=np.zeros_like(width), where=width > 0)
    first = values[:-2]
    straight = first + share * (values[2:] - first)
    distance = abs(values[1:-1] - straight)
    return np.asarray(is_step | (distance > _SAME))
