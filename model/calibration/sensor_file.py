"""The file of a desk's accelerometers: a place, an input of the sound card, and a sensitivity each.

CSV with the columns below, in any order; those of OPTIONAL may be left out, and all but PLACES
where only places are read. Where all lines name one input, that is one sensor, which is moved from
place to place.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from model.answer.stimulus import check_on_plate
from model.arrays import Point
from model.calibration.responses_file import sensor_mass
from model.errors import InputError
from model.files.csv_file import Line, read_lines
from model.structure.plate import Plate

PLACES = ("sensor", "x_m", "y_m")
COLUMNS = (*PLACES, "input", "mv_per_m_s2")
OPTIONAL = {"gain": 1.0, "full_scale_v": 1.0, "mass_g": 0.0}


@dataclass(frozen=True)
class WiredSensor:
    """An accelerometer at x, y [m] on an input of a sound card, counted from 1.

    sensitivity: samples, in full scale, by acceleration [1/(m/s²)]; mass [kg]: of one that is
    moved, as `model.identification.forward.Sensor.mass`.
    """

    name: str
    x: float
    y: float
    input: int
    sensitivity: float
    mass: float = 0.0


def read_places(path: Path, plate: Plate) -> dict[str, Point]:
    """Read places [m] of sensors on a plate by name; raises InputError with file and line."""
    places: dict[str, Point] = {}
    for line in read_lines(path, PLACES, optional=(*COLUMNS[len(PLACES) :], *OPTIONAL)):
        name, at = _place(line, places, plate)
        places[name] = at
    return places


def read_sensors(
    path: Path, plate: Plate, *, mass: float | None = None, may_move: bool = False
) -> tuple[WiredSensor, ...]:
    """Read the accelerometers of a plate, or the places of one that is moved.

    mass [g]: of the sensor, in place of the file's; may_move: whether one that is moved will do.
    Raises InputError with file and line.
    """
    sensors: list[WiredSensor] = []
    lines = read_lines(path, COLUMNS, optional=tuple(OPTIONAL))
    moves = may_move and len(lines) > 1 and len({line.number("input") for line in lines}) == 1
    for line in lines:
        sensors.append(_sensor(line, sensors, plate, mass=mass, moves=moves))
    if not moves and len(sensors) > 1 and any(sensor.mass for sensor in sensors):
        raise InputError(
            f"{path}: mass_g must be of one sensor that is moved, got several sensors, which weigh "
            "on the plate together; leave it out, and give them in the rig as masses"
        )
    return tuple(sensors)


def are_places(sensors: Sequence[WiredSensor]) -> bool:
    """Whether these are places of one sensor that is moved."""
    return len(sensors) > 1 and len({sensor.input for sensor in sensors}) == 1


def _place(line: Line, before: Collection[str], plate: Plate) -> tuple[str, Point]:
    """Name and place of a sensor, which the ones before do not have; raises InputError."""
    name = line.cells["sensor"]
    if not name or name in before:
        raise InputError(f"{line.place}: sensor must be a name that no other has, got {name!r}")
    at = line.number("x_m"), line.number("y_m")
    check_on_plate(f"{line.place}: sensor {name}", [at], plate)
    return name, at


def _sensor(
    line: Line, before: Sequence[WiredSensor], plate: Plate, *, mass: float | None, moves: bool
) -> WiredSensor:
    place = line.place
    name, (x, y) = _place(line, [other.name for other in before], plate)
    channel, sensitivity = map(line.number, ("input", "mv_per_m_s2"))
    is_taken = not moves and any(channel == other.input for other in before)
    if channel != int(channel) or channel < 1 or is_taken:
        raise InputError(
            f"{place}: input must be a number from 1 that no other sensor has, got {channel:g}; "
            "one that is moved from place to place is for era measure, alone in its file"
        )
    gain, full_scale, own = (line.number(column, default) for column, default in OPTIONAL.items())
    for column, value in (("gain", gain), ("full_scale_v", full_scale)):
        if value <= 0:
            raise InputError(f"{place}: {column} must be above zero, got {value:g}")
    weight = sensor_mass(place, own if mass is None else mass, column="mass_g")
    if sensitivity == 0:
        raise InputError(f"{place}: mv_per_m_s2 must not be zero, got 0; negative: upside down")
    found = WiredSensor(name, x, y, int(channel), 1e-3 * sensitivity * gain / full_scale, weight)
    if moves and before and replace(before[0], name=name, x=x, y=y) != found:
        raise InputError(
            f"{place}: one sensor that is moved must have one sensitivity, gain, full scale and "
            f"mass, got others than sensor {before[0].name}; make the columns the same in all lines"
        )
    return found
