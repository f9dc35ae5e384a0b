"""From acceleration to the readings of sensors: scale, noise, range, resolution.

Not modelled: mass, resonance, anti-alias filter, cross-axis sensitivity.
"""

import math
from collections.abc import Sequence
from typing import Protocol

import numpy as np

from model.arrays import FloatArray


class Transducer(Protocol):
    """Characteristics of a sensor."""

    @property
    def noise_density(self) -> float:
        """Density of its noise [m/s²/sqrt(Hz)], white up to half the sampling rate."""

    @property
    def reach(self) -> float:
        """Its range, plus or minus [m/s²]."""

    @property
    def resolution(self) -> float:
        """Its step [m/s²]; 0 for none."""

    @property
    def scale(self) -> float:
        """Reading per acceleration."""


def read_accelerations(
    transducers: Sequence[Transducer],
    accelerations: FloatArray,
    *,
    sample_rate: float,
    rng: np.random.Generator,
) -> FloatArray:
    """Readings (n, s) [m/s²] of sensors for accelerations (n, s) [m/s²]."""
    density = np.array([one.noise_density for one in transducers])
    reach = np.array([one.reach for one in transducers])
    resolution = np.array([one.resolution for one in transducers])
    readings = accelerations * [one.scale for one in transducers]
    # White noise of this density up to half the sampling rate has this standard deviation.
    readings += density * math.sqrt(sample_rate / 2) * rng.standard_normal(readings.shape)
    readings = np.clip(readings, -reach, reach)
    step = np.where(resolution > 0, resolution, 1.0)
    return np.where(resolution > 0, step * np.round(readings / step), readings)
