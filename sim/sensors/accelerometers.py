"""Virtual accelerometers on a simulated plate, and their readings of the last ten seconds.

The first amplifier of the bench reports them as its own sensors, beside those at its ERAs.
"""

from collections import deque
from collections.abc import Sequence

import numpy as np

from model.arrays import FloatArray
from model.errors import InputError
from sim.bench.bench import Bench
from sim.plant.accelerometer import Accelerometer, positions, readings
from sim.plant.fingers import KEPT, check_on_plate
from sim.sensors.recording import Recording

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
            check_on_plate(f"sensor {sensor.name}", (sensor.x, sensor.y), self._bench.rig.plate)
        self.sensors = tuple(sensors)
        self._bench.place_sensors(sensors)
        self._pieces.clear()
        if self in self._bench.probes:
            self._bench.probes.remove(self)
        if sensors:
            self._bench.probes.append(self)

    def record(self, times: FloatArray, accelerations: FloatArray) -> None:
        """Read accelerations: times (n,) [s], (n, s) [m/s²]."""
        if not len(times):
            return
        rate = self._bench.sample_rate
        read = readings(self.sensors, accelerations, sample_rate=rate, rng=self._rng)
        self._pieces.append((times, read))
        while self._pieces[0][0][-1] < times[-1] - KEPT:
            self._pieces.popleft()

    def read(self, since: float, until: float) -> Recording:
        """Readings in since <= t < until [s]; InputError where there are none."""
        pieces = [piece for piece in self._pieces if piece[0][-1] >= since and piece[0][0] < until]
        if not pieces:
            raise InputError(
                f"no readings from {since:g} to {until:g} s; place sensors first, and ask for the "
                f"last {KEPT:g} s at most"
            )
        return Recording(
            tuple(sensor.name for sensor in self.sensors),
            positions(self.sensors),
            self._bench.sample_rate,
            float(pieces[0][0][0]),
            np.concatenate([read for _, read in pieces]),
        ).during(since, until)
