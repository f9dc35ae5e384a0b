"""Vibrations that last at the same time, made one: a curve of intensity and one of sharpness."""

from typing import TypeAlias

import numpy as np

from controller.content.format import refusal
from controller.content.pattern import Curve
from model.arrays import FloatArray

Segment: TypeAlias = tuple[float, float, float, float, float, float]
"""Start and end [s], intensity at both, sharpness at both; straight lines between."""

_STEP = 0.005  # s; products and sums of straight lines are straight lines within it
_DIGITS = 9  # times are of whole nanoseconds, so that none are all but the same
_MAX_OVERLAP = 1_000_000  # parts of segments


def mixed(
    source: str,
    segments: list[Segment],
    *,
    factor: Curve = ((0.0, 1.0),),
    addend: Curve = ((0.0, 0.0),),
) -> tuple[Curve, Curve]:
    """Return intensity and sharpness of segments that may overlap.

    Intensities add as powers, up to 1; the sharpness is that of the strongest. factor, addend: of
    all intensities and sharpnesses over time. source: the file, for the error of too many.
    """
    rows = np.array(segments).reshape(-1, 6)
    rows[:, :2] = rows[:, :2].round(_DIGITS)
    rows = rows[rows[:, 1] > rows[:, 0]]
    if not len(rows):
        return (), ()
    begins, ends = rows[:, 0], rows[:, 1]
    given = [time for curve in (factor, addend) for time, _ in curve]
    grid = np.arange(begins.min(), ends.max(), _STEP)
    knots = np.unique(np.concatenate([begins, ends, np.round([*grid, *given], _DIGITS)]))
    knots = knots[(knots >= begins.min()) & (knots <= ends.max())]
    first = np.searchsorted(knots, begins)
    counts = np.searchsorted(knots, ends) - first
    if counts.sum() > _MAX_OVERLAP:
        raise refusal(source, "has too many events that overlap; shorten them")
    which = np.repeat(np.arange(len(rows)), counts)
    at = np.arange(len(which)) - np.repeat(np.cumsum(counts) - counts - first, counts)
    limits = np.stack([knots[at], knots[at + 1]])
    share = (limits - begins[which]) / (ends - begins)[which]
    levels, sharps = (
        rows[which, column] + share * (rows[which, column + 1] - rows[which, column])
        for column in (2, 4)
    )
    count = len(knots) - 1
    power = np.stack([np.bincount(at, level**2, minlength=count) for level in levels])
    order = np.argsort(levels.sum(axis=0), kind="stable")
    sharpness = np.full((2, count), np.nan)
    sharpness[:, at[order]] = sharps[:, order]  # of equal places the last, the strongest, stays
    intensity = np.sqrt(power) * between(factor, knots)
    sharpness += between(addend, knots)
    return _curve(knots, np.clip(intensity, 0, 1)), _curve(knots, np.clip(sharpness, 0, 1))


def between(curve: Curve, knots: FloatArray) -> FloatArray:
    """Return a curve (2, n) after and before the ends of each stretch between knots."""
    times, values = np.array(curve).T
    times = times.round(_DIGITS)
    width = np.diff(knots)
    early, late = (np.interp(knots[:-1] + part * width, times, values) for part in (0.25, 0.75))
    return np.stack([1.5 * early - 0.5 * late, 1.5 * late - 0.5 * early])


def _curve(knots: FloatArray, values: FloatArray) -> Curve:
    """Return the points that a curve needs; values (2, n) at both ends of each stretch."""
    times = np.stack([knots[:-1], knots[1:]], axis=1).ravel()
    course = values.T.ravel()
    is_given = ~np.isnan(course)
    return thinned(times[is_given], course[is_given])


def thinned(times: FloatArray, values: FloatArray) -> Curve:
    """Return a curve without the points that repeat another or lie on the line between two."""
    is_new = np.ones(len(times), bool)
    is_new[1:] = (np.diff(times) > 0) | (abs(np.diff(values)) > 1e-12)
    times, values = times[is_new], values[is_new]
    is_kept = np.ones(len(times), bool)
    if len(times) > 2:
        width = times[2:] - times[:-2]
        along = np.divide(
            times[1:-1] - times[:-2], width, out=np.zeros_like(width), where=width > 0
        )
        straight = values[:-2] + along * (values[2:] - values[:-2])
        is_step = (np.diff(times)[:-1] == 0) | (np.diff(times)[1:] == 0)
        is_kept[1:-1] = is_step | (abs(values[1:-1] - straight) > 1e-12)
    return tuple(zip(times[is_kept].tolist(), values[is_kept].tolist(), strict=True))
