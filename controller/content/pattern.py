"""Patterns: the common form of all content.

Like AHAP and HJIF, a pattern has curves over time (intensity and sharpness of its continuous part)
and transients. Sharpness, 0 to 1, represents a frequency.
"""

from array import array
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias, overload

import numpy as np

from model.arrays import FloatArray

MAX_CONTENT_DURATION = 60.0
"""Longest content [s]."""

MIN_HZ = 65.0
"""Frequency [Hz] of sharpness 0, used by the MPEG reference encoder for AHAP."""

MAX_HZ = 300.0
"""Frequency [Hz] of sharpness 1."""

_Point: TypeAlias = tuple[float, float]

Curve: TypeAlias = Sequence[_Point]
"""Times [s], which never decrease, and values 0 to 1: straight lines, with a step between points of
equal time."""


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
    transients = pattern.transients
    intensities = [(transient.time, transient.intensity) for transient in transients]
    sharpnesses = [(transient.time, transient.sharpness) for transient in transients]
    return (
        _curve_problem("intensity", pattern.intensity)
        or _curve_problem("sharpness", pattern.sharpness)
        or _curve_problem("intensity of transients", intensities)
        or _curve_problem("sharpness of transients", sharpnesses)
    )


def _curve_problem(name: str, curve: Curve) -> str:
    """Return the first problem of a curve, or ""."""
    last_time = 0.0
    for index, (time, value) in enumerate(curve):
        if not last_time <= time <= MAX_CONTENT_DURATION:
            limits = f"{last_time:g} to {MAX_CONTENT_DURATION:g} s"
            return f"time of {name}[{index}] must be {limits}, got {time:g} s"
        if not 0 <= value <= 1:
            return f"{name}[{index}] must be 0 to 1, got {value:g} at {time:g} s"
        last_time = time
    return ""


def curve_at(curve: Curve, times: FloatArray, *, beyond: float | None = None) -> FloatArray:
    """Return a curve at times [s]; beyond: value outside the curve, by default its end values."""
    curve_times, values = np.array(curve or ((0.0, 0.0),)).T
    return np.asarray(np.interp(times, curve_times, values, left=beyond, right=beyond))


def sharpness_of(hertz: FloatArray) -> FloatArray:
    """Return the sharpness of frequencies [Hz], 0 and 1 outside their range."""
    return np.asarray(((hertz - MIN_HZ) / (MAX_HZ - MIN_HZ)).clip(0, 1))


def hertz_of(sharpness: FloatArray) -> FloatArray:
    """Return the frequencies [Hz] of sharpness, 0 to 1."""
    return MIN_HZ + sharpness * (MAX_HZ - MIN_HZ)
