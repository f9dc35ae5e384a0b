"""Wiring of a rig and accelerometers to a sound card."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from era_haptics.lab.measuring.multisine import PERIOD
from model.arrays import ComplexArray, FloatArray
from model.errors import InputError
from model.estimate.forward import Sensor
from model.estimate.measurement import (
    INPUT_COLUMNS,
    PLACE_COLUMNS,
    Measurement,
    named_place,
    sensor_mass,
)
from model.files.csv_file import CsvLine, read_lines
from model.reduction.reduced_plate import reduce_plate
from model.rig.rig import Rig
from model.structure.attachments import footprints_of
from model.structure.plate import Plate
from model.transients.time_response import plate_in_time

MIN_SETTLING = 1.0
"""Minimum settling time [s] of a run; a plate with a typical loss factor has settled."""

_MAX_SETTLING = 5.0  # s
_REMAINING = 0.01  # of a free vibration, after settling
_OPTIONAL = dict(zip(INPUT_COLUMNS[2:], (1.0, 1.0, 0.0), strict=True))


def converters(response: ComplexArray) -> ComplexArray:
    """Complex loop-back response (f,), normalized to a median modulus of 1.

    Dividing by the loop-back removes the delay, including fractions of a sample, and the shape of
    filters. Gains remain, since levels and sensitivities are stated separately.
    """
    return np.asarray(response / np.median(np.abs(response)))


@dataclass(frozen=True)
class WiredSensor:
    """An accelerometer at x, y [m] on an input of a sound card."""

    name: str
    x: float
    y: float
    input: int
    """Number of the input, from 1."""
    sensitivity: float
    """Samples, in full scale, by acceleration [1/(m/s²)]."""
    mass: float = 0.0
    """Mass of a moved sensor [kg], like `model.estimate.forward.Sensor.mass`."""

    @property
    def place(self) -> Sensor:
        """The sensor on the plate, without its wiring."""
        return Sensor(self.name, x=self.x, y=self.y, mass=self.mass)


def read_sensors(
    path: Path, plate: Plate, *, mass: float | None = None, may_move: bool = False
) -> tuple[WiredSensor, ...]:
    """Read the accelerometers of a plate, or the positions of a moved one.

    mass [g]: of the sensor, overrides the file; may_move: whether a moved sensor is allowed. Raises
    InputError with file and line.
    """
    sensors: list[WiredSensor] = []
    columns = (*PLACE_COLUMNS, *INPUT_COLUMNS[:2])
    lines = [*read_lines(path, columns, optional=tuple(_OPTIONAL))]
    moves = may_move and len(lines) > 1 and len({line.number("input") for line in lines}) == 1
    for line in lines:
        sensors.append(_sensor(line, sensors, plate, mass=mass, moves=moves))
    if not moves and len(sensors) > 1 and any(sensor.mass for sensor in sensors):
        raise InputError(
            f"{path}: mass_g must be given for a single moved sensor, got several sensors, which "
            "all load the plate; leave it out, and give them in the rig as masses"
        )
    return tuple(sensors)


def are_positions(sensors: Sequence[WiredSensor]) -> bool:
    """Return whether the sensors are positions of a moved sensor."""
    return len(sensors) > 1 and len({sensor.input for sensor in sensors}) == 1


def _sensor(
    line: CsvLine,
    sensors: Sequence[WiredSensor],
    plate: Plate,
    *,
    mass: float | None,
    moves: bool,
) -> WiredSensor:
    """Read one line; sensors: of earlier lines; mass, moves: see `read_sensors`."""
    place = line.place
    name, (x, y) = named_place(line, [sensor.name for sensor in sensors], plate)
    number = _input_number(line, [] if moves else sensors)
    sensitivity = line.number("mv_per_m_s2")
    gain, full_scale, column_mass = (
        line.number(column, default) for column, default in _OPTIONAL.items()
    )
    for column, value in (("gain", gain), ("full_scale_v", full_scale)):
        if value <= 0:
            raise InputError(f"{place}: {column} must be above zero, got {value:g}")
    checked_mass = sensor_mass(place, column_mass if mass is None else mass, column="mass_g")
    if sensitivity == 0:
        raise InputError(f"{place}: mv_per_m_s2 must not be zero, got 0; negative: upside down")
    per_acceleration = 1e-3 * sensitivity * gain / full_scale
    sensor = WiredSensor(name, x, y, number, per_acceleration, checked_mass)
    if moves and sensors and replace(sensors[0], name=name, x=x, y=y) != sensor:
        raise InputError(
            f"{place}: one sensor that is moved must have one sensitivity, gain, full scale and "
            f"mass, got others than sensor {sensors[0].name}; make the columns the same in all "
            "lines"
        )
    return sensor


def _input_number(line: CsvLine, sensors: Sequence[WiredSensor]) -> int:
    """Return the number of an input that no other sensor has; raises InputError for others."""
    number = line.number("input")
    is_taken = any(number == sensor.input for sensor in sensors)
    if number != int(number) or number < 1 or is_taken:
        raise InputError(
            f"{line.place}: input must be a number from 1 that no other sensor has, got "
            f"{number:g}; a sensor moved between positions requires era measure, and a file of "
            "its own"
        )
    return int(number)


@dataclass(frozen=True)
class Desk:
    """Wiring of a rig to a sound card: ERAs by channel, counted from 1, and a loop-back.

    The loop-back is a cable from the output after the ERA outputs to the input after the sensor
    inputs. If the card has no free output, it shares the output of the last ERA (is_shared).
    """

    rig: Rig
    sensors: tuple[WiredSensor, ...]
    is_shared: bool = False

    @property
    def eras(self) -> list[tuple[str, int]]:
        """Name and output of each ERA."""
        return [(era.name, self.rig.wiring[era.name].number + 1) for era in self.rig.eras]

    @property
    def output(self) -> int:
        """Output of the loop-back, the last one."""
        last_output = max(output for _, output in self.eras)
        return last_output if self.is_shared else last_output + 1

    @property
    def sources(self) -> list[int]:
        """Output of each source: of the ERAs in their order, and of a loop-back of its own."""
        outputs = [output for _, output in self.eras]
        return outputs if self.is_shared else [*outputs, self.output]

    @property
    def input(self) -> int:
        """Input of the loop-back, the last one."""
        return max(sensor.input for sensor in self.sensors) + 1

    @property
    def looped(self) -> int:
        """Number of the source that the loop-back returns, the last one."""
        return self.sources.index(self.output)

    @property
    def named_inputs(self) -> dict[int, str]:
        """Description of each connected input, including the loop-back, by number."""
        names = {sensor.input: f"sensor {sensor.name}" for sensor in self.sensors}
        return names | {self.input: f"the loop-back of output {self.output}"}

    @property
    def columns(self) -> list[int]:
        """Index of each sensor's input."""
        return [sensor.input - 1 for sensor in self.sensors]

    @property
    def sensitivities(self) -> FloatArray:
        """Sensitivity of each sensor, see `WiredSensor`."""
        return np.array([sensor.sensitivity for sensor in self.sensors])

    def responses(
        self, frequencies: FloatArray, values: ComplexArray, looped: ComplexArray
    ) -> Measurement:
        """Convert responses of samples (f, inputs, sources) to acceleration per base displacement
        [1/s²].

        looped (f,): response of the loop-back.
        """
        full_levels = np.array([*self.rig.full_levels.values()])
        era_responses = values[:, self.columns, : len(self.eras)]
        compensated = era_responses / converters(looped)[:, None, None]
        return Measurement(
            tuple(sensor.place for sensor in self.sensors),
            frequencies,
            compensated / full_levels / self.sensitivities[:, None],
            drives_lag=True,
        )

    def on_outputs(self, sources: FloatArray) -> FloatArray:
        """Samples (n, outputs) of the sources (n, sources)."""
        columns = [output - 1 for output in self.sources]
        return np.asarray(sources @ np.eye(self.output)[columns])

    @cached_property
    def settling(self) -> float:
        """Time [s] until free vibrations have decayed to 1 %, in whole periods from 1 to 5 s.

        The slowest mode within the rig's limits decides; modes below the limits hardly move.
        Raises InputError for a plate that is not supported.
        """
        rig = self.rig
        points = footprints_of(rig.eras, rig.masses)
        high = rig.limits.frequency_max
        reduced = reduce_plate(rig.plate, rig.mesh, points, frequency_max=high)
        modes = plate_in_time(reduced, rig.eras, loads=rig.masses).eigenvalues
        hertz = np.abs(modes.imag) / (2 * np.pi)
        is_within = (hertz >= rig.limits.frequency_min) & (hertz <= high)
        slowest_decay = -float(modes.real[is_within].max(initial=-math.inf))
        decay = max(slowest_decay, -math.log(_REMAINING) / _MAX_SETTLING)
        return max(MIN_SETTLING, PERIOD * math.ceil(-math.log(_REMAINING) / decay / PERIOD))

    @property
    def highest(self) -> float:
        """Highest level that the rig's limits allow on all ERAs simultaneously."""
        limits = self.rig.limits
        return min(limits.level, float(np.sqrt(limits.power / len(self.rig.eras))), 1.0)

    def check(self, level: float) -> None:
        """Raise InputError for several amplifiers, or a level beyond the rig's limits."""
        if len({self.rig.wiring[era.name].amplifier for era in self.rig.eras}) > 1:
            raise InputError(
                "all ERAs must be on one sound card, got several amplifiers in the rig"
            )
        if not 0 < level <= self.highest:
            raise InputError(
                f"--level must be above 0 and at most {self.highest:.3g}, as the rig's limits "
                f"allow, got {level:g}"
            )

    def check_times(self, *, seconds: float, slew: float) -> None:
        """Raise InputError for time limits that prerecorded samples would violate.

        seconds: played without a pause; slew [1/s]: highest rise of a level.
        """
        limits = self.rig.limits
        for key, is_kept, played in (
            ("on_time", seconds <= limits.on_time, f"{seconds:.3g} s without a pause"),
            ("duty", limits.duty >= 1, "one run after the other"),
            ("slew", slew <= limits.slew, f"ramps of {slew:.3g} per second"),
        ):
            if not is_kept:
                raise InputError(
                    f"limits.{key} must allow the signals of a sound card, {played}, got "
                    f"{getattr(limits, key):g}; check that the ERAs withstand them, and widen it"
                )

    def check_frequencies(self, frequencies: FloatArray, *, what: str) -> None:
        """Raise InputError for frequencies [Hz] beyond the rig's limits; what: option's name."""
        limits = self.rig.limits
        low, high = limits.frequency_min, limits.frequency_max
        if frequencies.min() < low or frequencies.max() > high:
            raise InputError(
                f"{what} must be within the rig's limits.frequency of {low:g} to {high:g} "
                f"Hz, got {frequencies.min():g} to {frequencies.max():g} Hz"
            )
