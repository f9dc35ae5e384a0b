"""Recordings: readings of sensors over time, and what a file format for them has."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from model.arrays import ComplexArray, FloatArray
from model.errors import InputError
from sim.plant.felt import fit_tones


@dataclass(frozen=True, eq=False)
class Recording:
    """Readings [m/s²] of sensors, samples (n, s), the first at start [s].

    names, points (s, 2) [m]: of the sensors; sample_rate [Hz].
    """

    names: tuple[str, ...]
    points: FloatArray
    sample_rate: float
    start: float
    samples: FloatArray

    def __post_init__(self) -> None:
        """Check shapes and sampling rate."""
        shape = (len(self.samples), len(self.names))
        if np.shape(self.samples) != shape or np.shape(self.points) != (len(self.names), 2):
            raise InputError(
                f"samples and points must match the {len(self.names)} sensors, got shapes "
                f"{np.shape(self.samples)} and {np.shape(self.points)}"
            )
        if not (math.isfinite(self.sample_rate) and self.sample_rate > 0):
            raise InputError(f"sampling rate must be positive, got {self.sample_rate} Hz")

    @property
    def times(self) -> FloatArray:
        """Time of each sample [s], (n,)."""
        return np.asarray(self.start + np.arange(len(self.samples)) / self.sample_rate)

    def during(self, since: float, until: float) -> "Recording":
        """The part with since <= t < until [s]."""
        inside = np.flatnonzero((self.times >= since) & (self.times < until))
        if len(inside) == 0:
            raise InputError(f"no samples from {since:g} to {until:g} s")
        return Recording(
            self.names,
            self.points,
            self.sample_rate,
            float(self.times[inside[0]]),
            self.samples[inside],
        )

    def tones(self, frequencies: Sequence[float]) -> ComplexArray:
        """Complex amplitude (f, s) [m/s²] of tones, Im[a exp(i omega t)], t on the plate's clock.

        Least squares of all tones and a constant; it must be longer than the inverse of the
        smallest frequency difference. Raises InputError for fewer samples than unknowns.
        """
        needed = 2 * len(frequencies) + 1
        if len(self.samples) < needed:
            raise InputError(
                f"{len(frequencies)} tones need {needed} samples, got {len(self.samples)}: record "
                "longer"
            )
        return fit_tones(self.times, self.samples, frequencies, with_offset=True)


@dataclass(frozen=True)
class Format:
    """A file format.

    read: raises InputError with file and line; start: the first bytes of a file; max_values: limit
    that bounds memory; cannot_hold: why recordings of these names at this sampling rate [Hz] do not
    fit, None where they do; sidecars: the files beside one.
    """

    write: Callable[[Path, Recording], None]
    read: Callable[[Path], Recording]
    start: bytes
    max_values: int
    cannot_hold: Callable[[Sequence[str], float], str | None] = lambda names, sample_rate: None
    sidecars: Callable[[Path], tuple[Path, ...]] = lambda path: ()


def rounded(value: float, digits: int) -> float:
    """A value that was written with so many significant digits."""
    return float(f"{value:.{digits}g}")
