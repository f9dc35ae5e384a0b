"""Readings of sensors over a while: who read, where, from when on and how often."""

import math
from dataclasses import dataclass

import numpy as np

from model.arrays import FloatArray
from model.errors import InputError


@dataclass(frozen=True, eq=False)
class Recording:
    """Readings [m/s²] of some sensors, samples (n, s), the first at start [s].

    names, points (s, 2) [m]: of the sensors; sample_rate [Hz].
    """

    names: tuple[str, ...]
    points: FloatArray
    sample_rate: float
    start: float
    samples: FloatArray

    def __post_init__(self) -> None:
        """Refuse what does not fit together."""
        shape = (len(self.samples), len(self.names))
        if np.shape(self.samples) != shape or np.shape(self.points) != (len(self.names), 2):
            raise InputError(
                f"a recording of {len(self.names)} sensors needs as many columns and points"
            )
        if not (math.isfinite(self.sample_rate) and self.sample_rate > 0):
            raise InputError(f"sampling rate {self.sample_rate} Hz is none, must be above zero")

    @property
    def times(self) -> FloatArray:
        """When each sample was taken [s], (n,)."""
        return np.asarray(self.start + np.arange(len(self.samples)) / self.sample_rate)

    def during(self, since: float, until: float) -> "Recording":
        """The part with since <= t < until [s]."""
        inside = np.flatnonzero((self.times >= since) & (self.times < until))
        if len(inside) == 0:
            raise InputError(f"nothing was recorded from {since:g} to {until:g} s")
        return Recording(
            self.names,
            self.points,
            self.sample_rate,
            float(self.times[inside[0]]),
            self.samples[inside],
        )
