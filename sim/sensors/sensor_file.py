"""The file of a desk's accelerometers: a place, an input of the sound card, and a sensitivity each.

CSV with the columns below, in any order. Columns `gain` and `full_scale_v` may be left out.
"""

import csv
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from model.errors import InputError
from model.files.uff import read_bytes
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
    try:
        text = read_bytes(path).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: text must be UTF-8; save it as CSV in UTF-8") from error
    rows = csv.DictReader(io.StringIO(text), strict=True, skipinitialspace=True)
    sensors: list[WiredSensor] = []
    try:
        _check_columns(path, [*(rows.fieldnames or ())])
        for row in rows:
            sensors.append(_sensor(f"{path}:{rows.line_num}", row, sensors, plate))
    except csv.Error as error:
        raise InputError(
            f"{path}:{rows.line_num}: invalid CSV ({error}); check quotes and the end of the file"
        ) from error
    if not sensors:
        raise InputError(f"{path}:1: at least one line of a sensor must follow, got none")
    return tuple(sensors)


def _check_columns(path: Path, names: Sequence[str]) -> None:
    missing = [name for name in COLUMNS if name not in names]
    unknown = [name for name in names if name not in (*COLUMNS, *OPTIONAL)]
    if missing or unknown or len(set(names)) < len(names):
        raise InputError(
            f"{path}:1: columns must be {', '.join(COLUMNS)}, optionally {', '.join(OPTIONAL)}, "
            f"once each, got {', '.join(names)[:80] or 'none'}"
        )


def _sensor(
    place: str, row: Mapping[str, str | None], before: Sequence[WiredSensor], plate: Plate
) -> WiredSensor:
    def number(column: str) -> float:
        text = row.get(column) if column in row else str(OPTIONAL[column])
        try:
            value = float(text or "")
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise InputError(
                f"{place}: {column} must be a finite number, got {(text or '')[:30]!r}"
            )
        return value

    name = (row["sensor"] or "").strip()
    if not name or any(name == other.name for other in before):
        raise InputError(f"{place}: sensor must be a name that no other has, got {name!r}")
    x, y, channel = number("x_m"), number("y_m"), number("input")
    check_on_plate(f"{place}: sensor {name}", (x, y), plate)
    if channel != int(channel) or channel < 1 or any(channel == other.input for other in before):
        raise InputError(
            f"{place}: input must be a number from 1 that no other sensor has, got {channel:g}"
        )
    gain, full_scale = number("gain"), number("full_scale_v")
    sensitivity = number("mv_per_m_s2")
    for column, value in (("gain", gain), ("full_scale_v", full_scale)):
        if value <= 0:
            raise InputError(f"{place}: {column} must be above zero, got {value:g}")
    if sensitivity == 0:
        raise InputError(f"{place}: mv_per_m_s2 must not be zero, got 0; negative: upside down")
    return WiredSensor(name, x, y, int(channel), 1e-3 * sensitivity * gain / full_scale)
