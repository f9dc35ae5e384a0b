"""A reading of tones at sensors of a bench, by least squares over its window.

The normal equations of all tones and a constant are summed sample by sample, so that tones played
together do not leak into each other.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import final

import numpy as np

from model.arrays import FloatArray
from sim.plant.accelerometer import Accelerometer, readings


@dataclass(frozen=True)
class Measurement:
    """Tones [Hz] that are measured over a window [s]; number: of the reading."""

    number: int
    window: float
    frequencies: tuple[float, ...]


@final
class ToneReader:
    """Reads tones at sensors from `start` [s] on, while samples of its window come.

    shapes: returns those at its sensors (s, r); origin [s]: where t begins; token: of what plays.
    on_end: called with it after the last sample. offset: t at the start [s].
    """

    def __init__(
        self,
        measurement: Measurement,
        sensors: Sequence[Accelerometer],
        *,
        shapes: Callable[[], FloatArray],
        start: float,
        origin: float | None,
        token: int,
        sample_rate: float,
        rng: np.random.Generator,
        on_end: Callable[["ToneReader"], None],
    ) -> None:
        self.measurement = measurement
        self.end = start + measurement.window
        self.offset = 0.0 if origin is None else start - origin
        self.token = token
        self.is_disturbed = False
        self._sensors = tuple(sensors)
        self._shapes = shapes
        self._start = start
        self._sample_rate = sample_rate
        self._rng = rng
        self._on_end = on_end
        self._reach = np.array([one.reach for one in sensors])
        unknowns, count = 2 * len(measurement.frequencies) + 1, len(sensors)
        self._normal = np.zeros((unknowns, unknowns))
        self._right = np.zeros((unknowns, count))
        self._is_overloaded = np.zeros(count, dtype=bool)

    @property
    def shapes(self) -> FloatArray:
        """Shapes at its sensors."""
        return self._shapes()

    def record(self, times: FloatArray, accelerations: FloatArray) -> None:
        """Take samples: times (n,) [s], accelerations (n, s) [m/s²]."""
        inside = (times > self._start) & (times <= self.end)
        rate = self._sample_rate
        read = readings(self._sensors, accelerations[inside], sample_rate=rate, rng=self._rng)
        angles = 2 * math.pi * np.outer(times[inside] - self._start, self.measurement.frequencies)
        columns = np.hstack([np.sin(angles), np.cos(angles), np.ones((len(angles), 1))])
        self._normal += columns.T @ columns
        self._right += columns.T @ read
        self._is_overloaded |= (np.abs(read) >= self._reach).any(axis=0)
        if len(times) and times[-1] + 1 / self._sample_rate > self.end:
            self._on_end(self)

    def tones(self) -> list[tuple[bool, list[complex]]]:
        """Of each sensor: whether it was overloaded, and the phasors of its tones."""
        frequencies = np.array(self.measurement.frequencies)
        count = len(frequencies)
        found, *_ = np.linalg.lstsq(self._normal, self._right, rcond=None)
        phasors = found[:count] + 1j * found[count : 2 * count]
        phasors *= np.exp(-2j * math.pi * frequencies * self.offset)[:, None]
        return list(zip(self._is_overloaded.tolist(), phasors.T.tolist(), strict=True))
