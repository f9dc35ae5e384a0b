"""A reading of tones at sensors of a bench, by least squares over its window.

The normal equations of all tones and a constant are summed sample by sample, so that tones played
together do not leak into each other.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, final

import numpy as np

from model.arrays import FloatArray
from sim.plant.accelerometer import Accelerometer, positions, readings

if TYPE_CHECKING:
    from sim.bench.bench import Bench


@dataclass(frozen=True)
class Measurement:
    """Tones [Hz] that are measured over a window [s]; number: of the reading."""

    number: int
    window: float
    frequencies: tuple[float, ...]


@final
class ToneReader:
    """Reads tones at sensors of a bench from `start` [s] on, until its window has ended.

    origin [s]: where t begins; token: of what plays. offset: t at the start [s].
    """

    def __init__(
        self,
        bench: "Bench",
        measurement: Measurement,
        sensors: Sequence[Accelerometer],
        *,
        start: float,
        origin: float | None,
        token: int,
        rng: np.random.Generator,
    ) -> None:
        self.measurement = measurement
        self.end = start + measurement.window
        self.offset = 0.0 if origin is None else start - origin
        self.token = token
        self.is_disturbed = False
        self._bench = bench
        self._sensors = tuple(sensors)
        self._start = start
        self._rng = rng
        self._reach = np.array([one.reach for one in sensors])
        unknowns, count = 2 * len(measurement.frequencies) + 1, len(sensors)
        self._normal = np.zeros((unknowns, unknowns))
        self._right = np.zeros((unknowns, count))
        self._is_overloaded = np.zeros(count, dtype=bool)

    @property
    def shapes(self) -> FloatArray:
        """Shapes at its sensors."""
        return self._bench.shapes_at(positions(self._sensors))

    def record(self, times: FloatArray, accelerations: FloatArray) -> None:
        """Take samples: times (n,) [s], accelerations (n, s) [m/s²]."""
        inside = (times > self._start) & (times <= self.end)
        rate = self._bench.sample_rate
        read = readings(self._sensors, accelerations[inside], sample_rate=rate, rng=self._rng)
        angles = 2 * math.pi * np.outer(times[inside] - self._start, self.measurement.frequencies)
        columns = np.hstack([np.sin(angles), np.cos(angles), np.ones((len(angles), 1))])
        self._normal += columns.T @ columns
        self._right += columns.T @ read
        self._is_overloaded |= (np.abs(read) >= self._reach).any(axis=0)
        if len(times) and times[-1] + 1 / rate > self.end:
            self._bench.forget_reader(self)

    def tones(self) -> list[tuple[bool, list[complex]]]:
        """Of each sensor: whether it was overloaded, and the phasors of its tones."""
        frequencies = np.array(self.measurement.frequencies)
        count = len(frequencies)
        found, *_ = np.linalg.lstsq(self._normal, self._right, rcond=None)
        phasors = found[:count] + 1j * found[count : 2 * count]
        phasors *= np.exp(-2j * math.pi * frequencies * self.offset)[:, None]
        return list(zip(self._is_overloaded.tolist(), phasors.T.tolist(), strict=True))
