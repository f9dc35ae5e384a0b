"""Patterns: the common form of all content, from files and from points that a program sends.

Like AHAP and HJIF, a pattern has curves over time (intensity and sharpness of its continuous part)
and transients. Sharpness, 0 to 1, represents a frequency.
"""

from array import array
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias, overload

import numpy as np

from model.arrays import FloatArray
from model.errors import InputError

MAX_CONTENT_DURATION = 60.0
"""Longest content [s]."""

_Point: TypeAlias = tuple[float, float]

Curve: TypeAlias = Sequence[_Point]
"""Times [s], none before the one ahead of it, and values 0 to 1: straight lines, steps where two
times are equal."""


class CurvePoints(Sequence[_Point]):
    """Points of a curve, stored in two arrays: tuples would take 112 bytes per point.

    Freeing the tuples of 300 long files would also block the interpreter for 0.1 s.
    """

    def __init__(self, curve: Curve) -> None:
        self._times = array("d", [time for time, _ in curve])
        self._values = array("d", [value for _, value in curve])

    def __len__(self) -> int:
        """Return the number of points."""
        return len(self._times)

    @overload
    def __getitem__(self, index: int) -> _Point: ...

    @overload
    def __getitem__(self, index: slice) -> tuple[_Point, ...]: ...

    def __getitem__(self, index: int | slice) -> _Point | tuple[_Point, ...]:
        """Return a point, or the points of a slice."""
        if isinstance(index, slice):
            return tuple(zip(self._times[index], self._values[index], strict=True))
        return self._times[index], self._values[index]

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> FloatArray:
        """Return the points as an array (n, 2)."""
        return np.array([self._times, self._values], dtype=dtype).T

    def __eq__(self, other: object) -> bool:
        """Whether a curve has the same points."""
        if isinstance(other, CurvePoints):
            return self._times == other._times and self._values == other._values
        return tuple(self) == other

    def __hash__(self) -> int:
        """Return the hash of equal tuples."""
        return hash(tuple(self))

    def __repr__(self) -> str:
        """Show the points like a tuple."""
        return repr(tuple(self))


@dataclass(frozen=True)
class Transient:
    """A short tap at a time [s]: intensity and sharpness, 0 to 1."""

    time: float
    intensity: float
    sharpness: float


@dataclass(frozen=True)
class Pattern:
    """The content of a file."""

    duration: float
    """[s]"""
    intensity: Curve = ()
    """Intensity of the continuous part; 0 outside the curve."""
    sharpness: Curve = ()
    """Sharpness of the continuous part; constant beyond the ends of the curve."""
    transients: tuple[Transient, ...] = ()
    """Ascending in time."""
    remarks: tuple[str, ...] = ()
    """Changes to the file's content, and omissions."""
    out_of_band_share: float = 0.0
    """Omitted share of the energy of a sampled signal, 0 to 1."""

    def __post_init__(self) -> None:
        """Hold both curves in arrays."""
        object.__setattr__(self, "intensity", CurvePoints(self.intensity))
        object.__setattr__(self, "sharpness", CurvePoints(self.sharpness))


def misfit(pattern: Pattern) -> str:
    """Return the first problem of a pattern made by a format, or ""."""
    if not pattern.duration >= 0:  # also for NaN
        return f"must last 0 s or longer, got {pattern.duration:g} s"
    taps = pattern.transients
    for name, curve in (
        ("intensity", pattern.intensity),
        ("sharpness", pattern.sharpness),
        ("intensity of transients", [(each.time, each.intensity) for each in taps]),
        ("sharpness of transients", [(each.time, each.sharpness) for each in taps]),
    ):
        before = 0.0
        for index, (time, value) in enumerate(curve):
            if not before <= time <= MAX_CONTENT_DURATION:
                bounds = f"{before:g} to {MAX_CONTENT_DURATION:g} s"
                return f"time of {name}[{index}] must be {bounds}, got {time:g} s"
            if not 0 <= value <= 1:
                return f"{name}[{index}] must be 0 to 1, got {value:g} at {time:g} s"
            before = time
    return ""


def curve_at(curve: Curve, times: FloatArray, *, beyond: float | None = None) -> FloatArray:
    """Return a curve at times [s]; beyond: value outside the curve, by default as at its ends."""
    moments, values = np.array(curve or ((0.0, 0.0),)).T
    return np.asarray(np.interp(times, moments, values, left=beyond, right=beyond))


MIN_HZ, MAX_HZ = 65.0, 300.0
"""Frequencies [Hz] of sharpness 0 and 1, as in the MPEG reference encoder for AHAP."""


def sharpness_of(hertz: FloatArray) -> FloatArray:
    """Return the sharpness of frequencies [Hz], 0 and 1 outside their range."""
    return np.asarray(((hertz - MIN_HZ) / (MAX_HZ - MIN_HZ)).clip(0, 1))


def hertz_of(sharpness: FloatArray) -> FloatArray:
    """Return the frequencies [Hz] of sharpness, 0 to 1."""
    return MIN_HZ + sharpness * (MAX_HZ - MIN_HZ)


MAX_GIVEN = 500
"""Maximum number of points and taps together, as in OpenXR; Android guarantees 16."""

Given: TypeAlias = Sequence[Sequence[float]]
"""`[time_s, intensity, sharpness]` of each, in order of time."""

_Row: TypeAlias = tuple[float, float, float]


def pattern_of_points(points: Given, taps: Given = ()) -> Pattern:
    """Return a pattern with straight lines between points, and with taps.

    Raises InputError, with the index of the first invalid point or tap.
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
    """Return the points and taps of a pattern, evenly spaced points if it has too many.

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
    levels = np.append(levels, curve_at(pattern.intensity, between))[order]
    moments = moments[order]
    if len(moments) > room:
        moments = np.linspace(times[0], times[-1], room)
        levels = curve_at(pattern.intensity, moments)
    sharpness = curve_at(pattern.sharpness, moments)
    return [*zip(moments.tolist(), levels.tolist(), sharpness.tolist(), strict=True)], taps


def _checked(what: str, given: Given) -> Iterator[_Row]:
    """Yield points or taps; raises InputError for the first invalid one."""
    before = 0.0
    for index, each in enumerate(given):
        if len(each) != 3:
            raise InputError(
                f"{what}[{index}] must be [time_s, intensity, sharpness], got {len(each)} values"
            )
        time, intensity, sharpness = each
        if not before <= time <= MAX_CONTENT_DURATION:
            raise InputError(
                f"{what}[{index}] time_s must be {before:g} to {MAX_CONTENT_DURATION:g}, "
                f"got {time:g}"
            )
        for name, value in (("intensity", intensity), ("sharpness", sharpness)):
            if not 0 <= value <= 1:
                raise InputError(f"{what}[{index}] {name} must be 0 to 1, got {value:g}")
        before = time
        yield time, intensity, sharpness
