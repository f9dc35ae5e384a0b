"""Virtual accelerometers on the simulated plate.

A reading is the acceleration times the scale, plus white noise up to half the sampling rate,
clipped to the range and rounded to the resolution: see `sim.plant.transducer`. The first amplifier
of the bench reports them as its own sensors, beside those at its ERAs.
"""

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from model.arrays import FloatArray
from model.config.points import in_metres
from model.errors import InputError
from model.structure.plate import Plate
from sim.bench.bench import Bench
from sim.bench.sensing import PlateSensor
from sim.plant.fingers import KEPT
from sim.plant.transducer import read_accelerations
from sim.sensors.recording import Recording

MAX_SENSORS = 64  # ten seconds of readings take 50 MB


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
    readings = read_accelerations(sensors, accelerations, sample_rate=sample_rate, rng=rng)
    names = tuple(sensor.name for sensor in sensors)
    return Recording(names, positions(sensors), sample_rate, start, readings)


class Accelerometers:
    """The sensors on a bench, at first none, and their readings of the last ten seconds."""

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
        self._bench.place_sensors(
            [
                PlateSensor(
                    one.x,
                    one.y,
                    noise_density=one.noise_density,
                    reach=one.reach,
                    resolution=one.resolution,
                    scale=one.scale,
                )
                for one in sensors
            ]
        )
        self._pieces.clear()
        if self in self._bench.probes:
            self._bench.probes.remove(self)
        if sensors:
            self._bench.probes.append(self)

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
