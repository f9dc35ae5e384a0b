"""Courses: how strongly a stimulus is felt over its duration, as an envelope of its amplitude."""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from model.arrays import FloatArray
from model.errors import InputError
from model.transients.swings import DECAYED, Swing

MAX_POINTS = 20_000

KNOT_STEP = 0.010
"""Time [s] between the knots along which amplifiers play a course, where wires carry as many."""

STRONGEST = 0.040
"""Time [s] of the strongest moments of a course, by which it is felt."""

_STEP, _SHORT = 0.005, 1.0  # s; between samples of courses, half as much of short ones

SILENCE = 1e-6
"""Share that stands for 0: of a silence levels are finite."""


@dataclass(frozen=True)
class Course:
    """Shares of the highest amplitude of a stimulus over its duration.

    times [s]: ascending, the first is 0, the last its duration; shares: 0 to 1, along straight
    lines between.
    """

    times: tuple[float, ...]
    shares: tuple[float, ...]

    def __post_init__(self) -> None:
        """Check everything."""
        if not 2 <= len(self.times) == len(self.shares) <= MAX_POINTS:
            raise InputError(
                f"a course must have 2 to {MAX_POINTS} times and as many shares, got "
                f"{len(self.times)} and {len(self.shares)}"
            )
        if self.times[0] != 0 or not (np.diff(self.times) > 0).all():
            raise InputError("times of a course must ascend from 0")
        shares = np.array(self.shares)
        if not ((shares >= 0) & (shares <= 1)).all():  # False for NaN
            raise InputError(
                f"shares of a course must be 0 to 1, got {min(self.shares):g} to "
                f"{max(self.shares):g}"
            )

    @property
    def duration(self) -> float:
        """Its last time [s]."""
        return self.times[-1]

    @property
    def step(self) -> float:
        """Time [s] between its samples."""
        return _STEP if self.duration > _SHORT else _STEP / 2

    @cached_property
    def strongest_db(self) -> float:
        """Root mean square of its strongest moments [dB], relative to a share of 1."""
        times = np.asarray(self.step * np.arange(self.duration / self.step + 1), dtype=float)
        samples, count = np.maximum(self.at(times), SILENCE), round(STRONGEST / self.step)
        return float(10 * np.log10(np.convolve(samples**2, np.full(count, 1 / count)).max()))

    @cached_property
    def swings(self) -> tuple[Swing, ...]:
        """It as amplifiers may play it from knot to knot: once, then over and over.

        Where wires carry fewer knots, these are further apart.
        """
        return tuple([self._swing(factor * KNOT_STEP) for factor in (1, 2, 4)])

    def _swing(self, step: float) -> Swing:
        count, rest = (math.ceil(each / step) for each in (self.duration, DECAYED))
        times = np.asarray(step * np.arange(1, count + rest + 1), dtype=float)
        once = np.where(times < self.duration, self.at(times), 0.0)
        anew = self.at(np.mod(times, self.duration))
        return Swing((0.0, *once.tolist(), *anew.tolist()), step)

    def at(self, times: FloatArray) -> FloatArray:
        """Shares at times [s] (n,), 0 outside."""
        return np.asarray(np.interp(times, self.times, self.shares, left=0.0, right=0.0))
