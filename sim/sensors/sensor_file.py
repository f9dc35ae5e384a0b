"""The file of a desk's accelerometers: a place, an input of the sound card, and a sensitivity each.

CSV with the columns below, in any order. Columns `gain` and `full_scale_v` may be left out.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from model.errors import InputError
from model.files.csv_file import Line, read_lines
from model.structure.plate import Plate
from sim.plant.fingers import check_on_plate

COLUMNS = ("sensor", "x_m", "y_m", "input", "mv_per_m_s2")
OPTIONAL = {"gain": 1.0, "full_scale_v": 1.0}


@dataclass(frozen=True)
class WiredSensor:
    """An accelerometer at x, y [m] on an input of a sound card, counted from 1.

    sensitivity: samples, in full scale, by acceleration [1/(m/s²)].
    """

    name: str
    x: float
    y: float
    input: int
    sensitivity: float


def read_sensors(path: Path, plate: Plate) -> tuple[WiredSensor, ...]:
    """Read the accelerometers of a plate; raises InputError with file and line."""
    sensors: list[WiredSensor] = []
    for line in read_lines(path, COLUMNS, optional=tuple(OPTIONAL)):
        sensors.append(_sensor(line, sensors, plate))
    return tuple(sensors)


def _sensor(line: Line, before: Sequence[WiredSensor], plate: Plate) -> WiredSensor:
    place, name = line.place, line.cells["sensor"]
    if not name or any(name == other.name for other in before):
        raise InputError(f"{place}: sensor must be a name that no other has, got {name!r}")
    x, y, channel, sensitivity = map(line.number, ("x_m", "y_m", "input", "mv_per_m_s2"))
    check_on_plate(f"{place}: sensor {name}", (x, y), plate)
    if channel != int(channel) or channel < 1 or any(channel == other.input for other in before):
        raise InputError(
            f"{place}: input must be a number from 1 that no other sensor has, got {channel:g}"
        )
    gain, full_scale = (line.number(column, default) for column, default in OPTIONAL.items())
    for column, value in (("gain", gain), ("full_scale_v", full_scale)):
        if value <= 0:
            raise InputError(f"{place}: {column} must be above zero, got {value:g}")
    if sensitivity == 0:
        raise InputError(f"{place}: mv_per_m_s2 must not be zero, got 0; negative: upside down")
    return WiredSensor(name, x, y, int(channel), 1e-3 * sensitivity * gain / full_scale)
