"""Virtual accelerometers: scale, noise, range and resolution of their readings.

A reading is the acceleration times the scale, plus white noise up to half the sampling rate,
clipped to the range and rounded to the resolution. Not modelled: mass, resonance, anti-alias
filter, cross-axis sensitivity, delay.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from model.arrays import FloatArray
from model.errors import InputError


@dataclass(frozen=True)
class Accelerometer:
    """A sensor at x, y [m].

    noise_density [m/s²/sqrt(Hz)]; reach: range, plus or minus [m/s²]; resolution: step [m/s²], 0
    for none; scale: reading per acceleration; channel: whose ERA it sits at, if at any.
    """

    name: str
    x: float
    y: float
    noise_density: float = 0.0
    reach: float = math.inf
    resolution: float = 0.0
    scale: float = 1.0
    channel: int | None = None

    def __post_init__(self) -> None:
        """Check the ranges."""
        for key in ("x", "y", "noise_density", "resolution", "scale"):
            if not math.isfinite(getattr(self, key)):
                raise InputError(
                    f"sensor {self.name}: {key} must be finite, got {getattr(self, key)}"
                )
        if self.noise_density < 0 or self.resolution < 0 or not self.reach > 0:
            raise InputError(
                f"sensor {self.name}: noise density and resolution must be >= 0, reach > 0, got "
                f"{self.noise_density:g}, {self.resolution:g}, {self.reach:g}"
            )


def positions(sensors: Sequence[Accelerometer]) -> FloatArray:
    """Positions of sensors [m], (s, 2)."""
    return np.array([[sensor.x, sensor.y] for sensor in sensors], dtype=float).reshape(-1, 2)


def readings(
    sensors: Sequence[Accelerometer],
    accelerations: FloatArray,
    *,
    sample_rate: float,
    rng: np.random.Generator,
) -> FloatArray:
    """Readings (n, s) [m/s²] of sensors for accelerations (n, s) [m/s²]."""
    density = np.array([one.noise_density for one in sensors])
    reach = np.array([one.reach for one in sensors])
    resolution = np.array([one.resolution for one in sensors])
    found = accelerations * [one.scale for one in sensors]
    # White noise of this density up to half the sampling rate has this standard deviation.
    found += density * math.sqrt(sample_rate / 2) * rng.standard_normal(found.shape)
    found = np.clip(found, -reach, reach)
    step = np.where(resolution > 0, resolution, 1.0)
    return np.where(resolution > 0, step * np.round(found / step), found)
