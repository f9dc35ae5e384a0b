"""What a channel must show, as formulas of the decision: raised cosines and straight lines.

Written from the rules alone, without the playback that the product plays and bounds by. Amplitudes
are complex, in shares of full level; times [s] count from the commit.
"""

import cmath
import math
from collections.abc import Callable, Sequence
from typing import TypeAlias

Curve: TypeAlias = Callable[[float], complex]
Bounds: TypeAlias = Callable[[float], tuple[float, float]]
"""Least and largest level at a time."""
_POINTS, _POINT = (24, 600), 2e-5  # of an interval at which a curve is looked at; s apart
_PARTS = 4  # of an interval that has passed
_LATE_START = 0.002  # s; by which a transition may begin later
_DRIFT = 1e-3  # of a time, by the amplifier's clock


def polar(level: float, degrees: float) -> complex:
    """Return the amplitude of a level and a phase [degrees]."""
    return cmath.rect(level, math.radians(degrees))


def steady(amplitude: complex) -> Curve:
    """Return a tone that does not change."""
    return lambda time: amplitude


def cosine(ramp: float, first: complex, last: complex) -> Curve:
    """Return a raised cosine between two amplitudes along a ramp [s]."""

    def at(time: float) -> complex:
        if time >= ramp:
            return last
        part = (1 - math.cos(math.pi * max(time, 0.0) / ramp)) / 2
        return first + (last - first) * part

    return at


def lines(step: float, *points: complex) -> Curve:
    """Return straight lines through points a step [s] apart, the first at 0."""

    def at(time: float) -> complex:
        steps = max(time, 0.0) / step
        if steps >= len(points) - 1:
            return points[-1]
        index = int(steps)
        return points[index] + (points[index + 1] - points[index]) * (steps - index)

    return at


def later(delay: float, before: Curve, after: Curve) -> Curve:
    """Return one curve until a delay [s], from then on another, whose time counts from there."""
    return lambda time: before(time) if time < delay else after(time - delay)


def alone(curve: Curve) -> Bounds:
    """Return the level of one voice."""
    return lambda time: (abs(curve(time)), abs(curve(time)))


def together(*curves: Curve) -> Bounds:
    """Return the level of voices of frequencies that differ: their magnitudes, added."""

    def at(time: float) -> tuple[float, float]:
        level = min(sum(abs(curve(time)) for curve in curves), 1.0)
        return level, level

    return at


def alike(*curves: Curve) -> Bounds:
    """Return the level of voices of one frequency, which may be shown as they interfere."""

    def at(time: float) -> tuple[float, float]:
        amplitudes = [curve(time) for curve in curves]
        return min(abs(sum(amplitudes)), 1.0), min(sum(map(abs, amplitudes)), 1.0)

    return at


def unsure(make: Callable[[float], Bounds], passed: tuple[float, float]) -> Bounds:
    """Return the levels of what began when another had passed for a time within an interval [s]."""
    low, high = max(passed[0] - _LATE_START, 0.0), passed[1]
    cases = [make(low + (high - low) * part / _PARTS) for part in range(_PARTS + 1)]

    def at(time: float) -> tuple[float, float]:
        levels = [case(time) for case in cases]
        return min(low for low, _ in levels), max(high for _, high in levels)

    return at


def within(bounds: Bounds, earliest: float, latest: float) -> tuple[float, float]:
    """Return the least and largest level of an interval [s], with what clocks may be off."""
    low = earliest * (1 - _DRIFT) - _LATE_START
    high = max(latest * (1 + _DRIFT), low)
    count = min(max(round((high - low) / _POINT), _POINTS[0]), _POINTS[1])
    width = (high - low) / (count - 1)
    levels = [bounds(low + width * point) for point in range(count)]
    return min(low for low, _ in levels), max(high for _, high in levels)


def interference(levels: Sequence[float], phases: Sequence[float]) -> float:
    """Return the level of tones of one frequency; phases in radians."""
    return abs(sum(cmath.rect(*each) for each in zip(levels, phases, strict=True)))
