"""Virtual accelerometers on the simulated plate.

A reading is the acceleration times the scale, plus white noise up to half the sampling rate,
clipped to the range and rounded to the resolution. Not modelled: mass, resonance, anti-alias
filter, cross-axis sensitivity.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from model.arrays import FloatArray
from model.errors import InputError
from model.structure.plate import Plate
from sim.sensors.recording import Recording


@dataclass(frozen=True)
class Accelerometer:
    """A sensor at x, y [m].

    noise_density [m/s²/sqrt(Hz)]; reach: range, plus or minus [m/s²]; resolution: step [m/s²], 0
    for none; scale: reading per acceleration.
    """

    name: str
    x: float
    y: float
    noise_density: float = 0.0
    reach: float = math.inf
    resolution: float = 0.0
    scale: float = 1.0

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


def scanning_grid(plate: Plate, nx: int, ny: int, *, like: Accelerometer) -> list[Accelerometer]:
    """nx by ny equal sensors in the centres of as many cells; P1 is nearest the origin, x first."""
    if nx < 1 or ny < 1:
        raise InputError(f"scanning grid must have at least 1x1 points, got {nx}x{ny}")
    return [
        Accelerometer(
            f"P{row * nx + column + 1}",
            (column + 0.5) / nx * plate.length,
            (row + 0.5) / ny * plate.width,
            like.noise_density,
            like.reach,
            like.resolution,
            like.scale,
        )
        for row in range(ny)
        for column in range(nx)
    ]


def read_sensors(
    sensors: Sequence[Accelerometer],
    accelerations: FloatArray,
    *,
    sample_rate: float,
    start: float,
    rng: np.random.Generator,
) -> Recording:
    """Readings of sensors for accelerations (n, s) [m/s²]; start: time of the first sample [s]."""
    density = np.array([sensor.noise_density for sensor in sensors])
    reach = np.array([sensor.reach for sensor in sensors])
    resolution = np.array([sensor.resolution for sensor in sensors])
    readings = accelerations * [sensor.scale for sensor in sensors]
    # White noise of this density up to half the sampling rate has this standard deviation.
    readings += density * math.sqrt(sample_rate / 2) * rng.standard_normal(readings.shape)
    readings = np.clip(readings, -reach, reach)
    step = np.where(resolution > 0, resolution, 1.0)
    readings = np.where(resolution > 0, step * np.round(readings / step), readings)
    names = tuple(sensor.name for sensor in sensors)
    return Recording(names, positions(sensors), sample_rate, start, readings)
