"""Accelerometers at the inputs of a sound card, read from a file.

A file lists either several sensors, each on its own input, or the positions of one moved sensor,
all with the same input.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from model.errors import InputError
from model.estimate.forward import Sensor
from model.files.csv_file import CsvLine, read_lines
from model.response_files import PLACE_COLUMNS, named_place, sensor_mass
from model.structure.plate import Plate

_REQUIRED_COLUMNS = (*PLACE_COLUMNS, "input", "mv_per_m_s2")
_OPTIONAL_COLUMNS = ("gain", "full_scale_v", "mass_g")


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


def are_positions(sensors: Sequence[WiredSensor]) -> bool:
    """Return whether the sensors are positions of a moved sensor."""
    return len(sensors) > 1 and len({sensor.input for sensor in sensors}) == 1


def read_sensors(
    path: Path, plate: Plate, *, mass: float | None = None, may_move: bool = False
) -> tuple[WiredSensor, ...]:
    """Read the accelerometers of a plate, or the positions of a moved one.

    mass [g]: of the sensor, overrides the file; may_move: whether a moved sensor is allowed. Raises
    InputError with file and line.
    """
    lines = list(read_lines(path, _REQUIRED_COLUMNS, optional=_OPTIONAL_COLUMNS))
    moves = may_move and len(lines) > 1 and len({line.number("input") for line in lines}) == 1
    sensors: list[WiredSensor] = []
    for line in lines:
        sensors.append(_sensor(line, sensors, plate, mass=mass, moves=moves))
    if not moves and len(sensors) > 1 and any(sensor.mass for sensor in sensors):
        raise InputError(
            f"{path}: mass_g must be given for a single moved sensor, got several sensors, which "
            "all load the plate; leave it out, and give them in the rig as masses"
        )
    return tuple(sensors)


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
    gain = line.number("gain", 1.0)
    full_scale = line.number("full_scale_v", 1.0)
    column_mass = line.number("mass_g", 0.0)
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
