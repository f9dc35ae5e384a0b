"""Boards of the weekend as they may be built, and what one moved sensor reads of them.

Each is the board of examples/weekend/rig.yaml. Exciters, drives, board and feet are drawn within
the uncertainty of the rig, force factors and magnets by 10 %. The sensor of
examples/weekend/places.csv is put by hand: half a millimeter off, with a scale of its own at each
place, and with noise. Everything is computed in memory, without a sound card.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from era_haptics.lab.measuring.sensor_file import WiredSensor, read_sensors
from model.arrays import ComplexArray, FloatArray
from model.estimate.measurement import Measurement
from model.reduction.free_plate import FreePlate, solve_free_plate
from model.rig.rig import Rig
from model.structure.attachments import PointLoad
from model.structure.exciter import Exciter
from sim.plant.imperfections import draw_imperfections

FOLDER = Path(__file__).parents[3] / "examples" / "weekend"
SEED = 62
FORCE_FACTOR = 0.1
MAGNET = 0.1
"""Standard deviations of parts that the rig's uncertainty does not have, relative."""
PLACE = 0.5e-3  # m
SCALE = 0.01
"""Standard deviations of a sensor's position along each axis, and of its scale."""
NOISE = 2e-3
"""Standard deviation of the real and imaginary parts, relative to a sensor's root mean square."""


@dataclass(frozen=True, eq=False)
class BuiltBoard:
    """A board with the true values of its parts, gains of the drives included."""

    rig: Rig
    free: FreePlate

    @classmethod
    def drawn(cls, rig: Rig, seed: int) -> "BuiltBoard":
        """Draw a board."""
        rng = np.random.default_rng([SEED, seed])
        drawn = draw_imperfections(rig, seed=seed)
        real = drawn.plate.realised(rig)
        exciters = []
        for exciter, gain in zip(real.eras, drawn.factors(rig), strict=True):
            assert isinstance(exciter, Exciter)
            force_factor = exciter.force_factor * (1 + FORCE_FACTOR * rng.standard_normal())
            magnet_mass = exciter.magnet_mass * (1 + MAGNET * rng.standard_normal())
            gains = ((100.0, float(abs(gain)), float(np.angle(gain))),)
            exciters.append(
                replace(exciter, force_factor=force_factor, magnet_mass=magnet_mass, gains=gains)
            )
        real = replace(real, eras=tuple(exciters))
        highest = real.limits.frequency_max
        return cls(real, solve_free_plate(real.plate, real.mesh, frequency_max=highest))

    def measured(self, frequencies: FloatArray, seed: int) -> Measurement:
        """Return the responses that the moved sensor reads, with its noise."""
        meant = read_sensors(FOLDER / "places.csv", self.rig.plate, may_move=True)
        readings = []
        for sensor, intended in zip(_put_by_hand(meant, seed), meant, strict=True):
            scale = sensor.sensitivity / intended.sensitivity
            readings.append(scale * self._response_at(sensor, frequencies))
        values = np.concatenate(readings, axis=2)
        values /= np.array([exciter.full_level for exciter in self.rig.eras])[:, None]
        rms = np.sqrt((np.abs(values) ** 2).mean(axis=(0, 1)))
        noise = np.random.default_rng([SEED, seed, 1]).standard_normal((2, *values.shape))
        values = values + NOISE * rms * (noise[0] + 1j * noise[1])
        return Measurement([place.place for place in meant], frequencies, values.swapaxes(1, 2))

    def _response_at(self, sensor: WiredSensor, frequencies: FloatArray) -> ComplexArray:
        """Acceleration (f, e, 1) [m/s²] of exciters at full level at a sensor with its mass."""
        position = np.array([[sensor.x, sensor.y]])
        loads = [*self.rig.masses, PointLoad(sensor.x, sensor.y, mass=sensor.mass)]
        return self.free.acceleration(self.rig.eras, frequencies, position, loads=loads)


def _put_by_hand(places: Sequence[WiredSensor], seed: int) -> list[WiredSensor]:
    """Return the sensor at each place as a hand puts it: off its place, and not quite upright."""
    errors = np.random.default_rng([SEED, seed, 3]).standard_normal((len(places), 3))
    errors *= [PLACE, PLACE, SCALE]
    sensors = []
    for place, (x, y, scale) in zip(places, errors.tolist(), strict=True):
        sensitivity = place.sensitivity * (1 + scale)
        sensors.append(replace(place, x=place.x + x, y=place.y + y, sensitivity=sensitivity))
    return sensors


def measured_board(rig: Rig, seed: int) -> tuple[BuiltBoard, Measurement]:
    """Build a board and measure it."""
    built = BuiltBoard.drawn(rig, seed)
    frequencies = np.arange(rig.limits.frequency_min + 1, rig.limits.frequency_max, 10.0)
    return built, built.measured(frequencies, seed)
