"""Accelerometers on a bench, and what they read."""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from model.answer.stimulus import check_on_plate
from model.arrays import ComplexArray, FloatArray
from model.errors import InputError
from sim.bench.bench import Bench
from sim.plant.fingers import HISTORY_DURATION, Accelerometer, fit_tones, positions, readings


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


MAX_SENSORS = 64  # ten seconds of readings take 50 MB


class Accelerometers:
    """The sensors on a bench, at first none."""

    def __init__(self, bench: Bench) -> None:
        self._bench = bench
        self._rng = np.random.default_rng(0)
        self._pieces: deque[tuple[FloatArray, FloatArray]] = deque()  # times, readings
        self.sensors: tuple[Accelerometer, ...] = ()

    @property
    def shapes(self) -> FloatArray:
        """Shapes at the sensors, in the present coordinates of the plate."""
        return self._bench.shapes_at(positions(self.sensors))

    def place(self, sensors: Sequence[Accelerometer]) -> None:
        """Replace the sensors; InputError changes nothing."""
        if len(sensors) > MAX_SENSORS:
            raise InputError(f"number of sensors must be at most {MAX_SENSORS}, got {len(sensors)}")
        names = [sensor.name for sensor in sensors]
        if len(set(names)) < len(names):
            raise InputError(f"names of sensors must be unique, got {', '.join(names)}")
        for sensor in sensors:
            check_on_plate(f"sensor {sensor.name}", [(sensor.x, sensor.y)], self._bench.rig.plate)
        self.sensors = tuple(sensors)
        self._pieces.clear()
        if self in self._bench.probes:
            self._bench.probes.remove(self)
        if sensors:
            self._bench.probes.append(self)

    def record(self, times: FloatArray, accelerations: FloatArray) -> None:
        """Read accelerations: times (n,) [s], (n, s) [m/s²]."""
        rate = self._bench.sample_rate
        read = readings(self.sensors, accelerations, sample_rate=rate, rng=self._rng)
        self._pieces.append((times, read))
        while self._pieces[0][0][-1] < times[-1] - HISTORY_DURATION:
            self._pieces.popleft()

    def read(self, since: float, until: float) -> Recording:
        """Readings in since <= t < until [s]; InputError where there are none."""
        pieces = [piece for piece in self._pieces if piece[0][-1] >= since and piece[0][0] < until]
        if not pieces:
            raise InputError(
                f"no readings from {since:g} to {until:g} s; place sensors first, and ask for the "
                f"last {HISTORY_DURATION:g} s at most"
            )
        return Recording(
            tuple(sensor.name for sensor in self.sensors),
            positions(self.sensors),
            self._bench.sample_rate,
            float(pieces[0][0][0]),
            np.concatenate([read for _, read in pieces]),
        ).during(since, until)
