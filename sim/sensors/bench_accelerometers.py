"""Virtual accelerometers on a running bench, with their readings of the last ten seconds."""

from collections import deque
from collections.abc import Sequence

import numpy as np

from model.arrays import FloatArray
from model.config.points import in_metres
from model.errors import InputError
from sim.bench.bench import Bench
from sim.plant.fingers import KEPT
from sim.sensors.accelerometer import Accelerometer, positions, read_sensors
from sim.sensors.recording import Recording

MAX_SENSORS = 64  # ten seconds of readings take 50 MB


class Accelerometers:
    """The sensors on a bench, at first none; their noise is reproducible."""

    def __init__(self, bench: Bench) -> None:
        self._bench = bench
        self._rng = np.random.default_rng(0)
        self._pieces: deque[Recording] = deque()
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
        plate = self._bench.rig.plate
        for sensor in sensors:
            if not plate.contains(sensor.x, sensor.y):
                raise InputError(
                    f"sensor {sensor.name} must be on the plate, (0, 0) to ({plate.length:g}, "
                    f"{plate.width:g}) m, got ({sensor.x:g}, {sensor.y:g}) m"
                    f"{in_metres(sensor.x, sensor.y, length=plate.length, width=plate.width)}"
                )
        self.sensors = tuple(sensors)
        self._pieces.clear()
        if self in self._bench.taps:
            self._bench.taps.remove(self)
        if sensors:
            self._bench.taps.append(self)

    def record(self, times: FloatArray, accelerations: FloatArray) -> None:
        """Read accelerations: times (n,) [s], (n, s) [m/s²]."""
        if not len(times):
            return
        self._pieces.append(
            read_sensors(
                self.sensors,
                accelerations,
                sample_rate=self._bench.sample_rate,
                start=float(times[0]),
                rng=self._rng,
            )
        )
        while self._pieces[0].times[-1] < times[-1] - KEPT:
            self._pieces.popleft()

    def read(self, since: float, until: float) -> Recording:
        """Readings in since <= t < until [s]; InputError where there are none."""
        pieces = [
            piece for piece in self._pieces if piece.times[-1] >= since and piece.start < until
        ]
        if not pieces:
            raise InputError(
                f"no readings from {since:g} to {until:g} s; place sensors first, and ask for the "
                f"last {KEPT:g} s at most"
            )
        first = pieces[0]
        whole = Recording(
            first.names,
            first.points,
            first.sample_rate,
            first.start,
            np.concatenate([piece.samples for piece in pieces]),
        )
        return whole.during(since, until)
