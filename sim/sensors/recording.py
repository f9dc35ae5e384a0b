"""Recordings: readings of sensors over time."""

from collections.abc import Sequence
from dataclasses import dataclass

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
