"""Files of measured responses, and the accelerometer file.

A CSV file has the columns `COLUMNS`, one value per row, in any order. A UFF file has a function of
type 4 for every sensor and ERA, acceleration over displacement, with the nodes' positions in
dataset 15 or 2411. The reference node is the ERA, identified by name or position. Responses to
exciters are per volt: in columns `real_m_s2_v` and `imag_m_s2_v`, or in functions whose reference
has the general data type (1) and the unit V. The mass of a moved sensor and the setting of a
measurement have their own columns, or are in the second line of free text of a function:
`sensor_mass_g=2 setting=level 0.1`.

Sensor positions are read from the accelerometer file, whose other columns describe their inputs
(`era_haptics.lab.measuring.measure`).
"""

import logging
import math
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from model.answer.stimulus import check_on_plate
from model.arrays import Point
from model.errors import InputError
from model.estimate.forward import Sensor
from model.estimate.measurement import Measurement
from model.files.csv_file import Column, CsvLine, read_lines, write_columns
from model.files.uff import (
    ACCELERATION,
    DISPLACEMENT,
    FREQUENCY_RESPONSE,
    UFF_FREQUENCY,
    Function,
    Universal,
    read_universal,
    write_universal,
)
from model.rig.rig import Rig
from model.structure.exciter import Actuator
from model.structure.plate import Plate
from model.structure.statics import GRAVITY

_logger = logging.getLogger(__name__)

# Columns of a file of responses.
COLUMNS = ("era", "sensor", "x_m", "y_m", "frequency_hz", "real_1_s2", "imag_1_s2")
_PER_VOLT = ("real_m_s2_v", "imag_m_s2_v")  # instead of the last two
ERA_COLUMNS = ("era_x_m", "era_y_m")  # optional
_MASS, SETTING = "sensor_mass_g", "setting"  # optional, too
_NOTE = re.compile(rf"\b{_MASS}=(?P<mass>\S+)(?:\s+{SETTING}=(?P<setting>.*))?")

# Columns of the accelerometer file; those of inputs are optional.
PLACE_COLUMNS = ("sensor", "x_m", "y_m")
INPUT_COLUMNS = ("input", "mv_per_m_s2", "gain", "full_scale_v", "mass_g")

MAX_SENSOR_MASS = 500.0
"""Largest mass of a moved sensor [g]; a heavier one is not an accelerometer."""

# Tolerances of a ruler [m]: of an ERA's position, and of a sensor beyond the plate's edge.
_ERA_TOLERANCE = 5e-3
_EDGE_TOLERANCE = 1e-3

_UP = 3  # +z
_GENERAL = 1  # data type of any other quantity
_FIRST_ERA_NODE = 1001
# SI units by label, without blanks, brackets, powers' signs and the dot of abbreviations.
_ACCELERATION_UNITS = {
    **dict.fromkeys(("", "m/s2", "m/s/s", "m/ss", "ms-2", "ms2", "meter/s2"), 1.0),
    **dict.fromkeys(("mm/s2", "mm/s/s"), 1e-3),
    **dict.fromkeys(("g", "gs", "gn", "g0"), GRAVITY),
    **dict.fromkeys(("in/s2", "in/s/s", "inch/s2"), 0.0254),
}
_DISPLACEMENT_UNITS = {
    **dict.fromkeys(("", "m", "meter", "metre"), 1.0),
    **dict.fromkeys(("mm",), 1e-3),
    **dict.fromkeys(("um", "micron"), 1e-6),
    **dict.fromkeys(("in", "inch"), 0.0254),
}
_FREQUENCY_UNITS = {
    **dict.fromkeys(("", "hz", "hertz", "1/s", "s-1", "cps"), 1.0),
    "khz": 1e3,
    "rad/s": 0.5 / math.pi,
}
_SPELLED = {ord("²"): "2", ord("µ"): "u", ord("μ"): "u", **dict.fromkeys(map(ord, "^*()[]{}·.' "))}


@dataclass(frozen=True)
class MeasuredValue:
    """Acceleration at a sensor per base displacement of an ERA, or per volt at an exciter.

    Phases as exp(+i omega t), upwards positive for both.
    """

    era: str
    """Name of the ERA, "" if only its position is known."""
    sensor: str
    point: tuple[float, float]
    """Position of the sensor x, y [m]."""
    era_point: tuple[float, float] | None
    """Position of the ERA x, y [m], None if unknown."""
    frequency: float
    """Frequency [Hz]."""
    value: complex
    """Response [1/s²], per volt [m/s²/V]."""
    place: str
    """File and line, for errors."""
    sensor_mass: float = 0.0
    """Mass of a sensor that is moved [kg], as `Sensor.mass`."""
    setting: str = ""
    """Setting of the measurement in words, "" if unknown."""
    is_per_volt: bool = False
    """Whether it is per volt at an exciter."""


def measurement_of(measured: Sequence[MeasuredValue], rig: Rig) -> Measurement:
    """Combine values into a measurement of a rig's plate; drives are assumed to lag (sound card).

    Values outside the rig's frequency limits, such as a spectrum's 0 Hz line, are skipped. Raises
    InputError, with file and line, for points off the plate, unknown ERAs or positions, duplicate
    responses, a sensor at two positions, and if no value is left.
    """
    within = _within_limits(measured, rig)
    first: dict[str, MeasuredValue] = {}
    eras: dict[tuple[str, Point | None], int] = {}
    responses: dict[tuple[float, int, str], complex] = {}
    for response in within:
        if response.sensor not in first:
            _check_point(response, rig)
            first[response.sensor] = response
        _check_sensor(response, first[response.sensor])
        drive = (response.era, response.era_point)
        if drive not in eras:
            eras[drive] = _era_of(response, rig)
        number = eras[drive]
        _check_unit(response, rig.eras[number])
        path = (response.frequency, number, response.sensor)
        if path in responses:
            raise InputError(
                f"{response.place}: response of sensor {response.sensor} to ERA "
                f"{rig.eras[number].name} at {response.frequency:g} Hz must be given once, got two"
            )
        responses[path] = response.value
    frequencies = np.unique([response.frequency for response in within])
    values = np.full((len(frequencies), len(first), len(rig.eras)), np.nan, dtype=complex)
    rows = {frequency: row for row, frequency in enumerate(frequencies.tolist())}
    columns = {name: column for column, name in enumerate(first)}
    for (frequency, number, sensor), value in responses.items():
        values[rows[frequency], columns[sensor], number] = value
    return Measurement(
        sensors=tuple(_sensor_at(response, rig.plate) for response in first.values()),
        frequencies=frequencies,
        values=values,
        drives_lag=True,
        skipped=len(measured) - len(within),
    )


def _within_limits(measured: Sequence[MeasuredValue], rig: Rig) -> list[MeasuredValue]:
    """Return the values within the rig's frequency limits; raises InputError if none is."""
    low = rig.limits.frequency_min
    high = rig.limits.frequency_max
    within = [response for response in measured if low <= response.frequency <= high]
    limits = f"the rig's limits.frequency of {low:g} to {high:g} Hz"
    if measured and not within:
        raise InputError(
            f"{measured[0].place}: a frequency must be within {limits}, got "
            f"{measured[0].frequency:g} Hz; measure others or widen the limits"
        )
    skipped = len(measured) - len(within)
    if skipped:
        _logger.warning("%d of %d values beyond %s are left out", skipped, len(measured), limits)
    return within


def _sensor_at(measured: MeasuredValue, plate: Plate) -> Sensor:
    """Return the sensor of a value; a point at the edge may have been rounded off the plate."""
    x, y = np.clip(measured.point, 0, [plate.length, plate.width]).tolist()
    return Sensor(measured.sensor, x=x, y=y, mass=measured.sensor_mass)


def _check_unit(measured: MeasuredValue, era: Actuator) -> None:
    """Raise InputError if a response is per volt at an ERA, or per displacement at an exciter."""
    if measured.is_per_volt == (era.UNIT == "V"):
        return
    right, wrong = "volt at the exciter", "displacement of the base of an ERA"
    if measured.is_per_volt:
        right, wrong = wrong, right
    raise InputError(
        f"{measured.place}: response to {era.name} must be acceleration per {right}, got "
        f"per {wrong}; check the rig, or its unit"
    )


def _check_sensor(measured: MeasuredValue, first: MeasuredValue) -> None:
    """Raise InputError unless a sensor is where its first value has it, and weighs as much."""
    subject = f"{measured.place}: sensor {measured.sensor}"
    if math.dist(first.point, measured.point) > _EDGE_TOLERANCE:
        raise InputError(
            f"{subject} must have one position, got {_shown(first.point)} ({first.place}) and "
            f"{_shown(measured.point)} m; name sensors differently"
        )
    if measured.sensor_mass != first.sensor_mass:
        raise InputError(
            f"{subject} must have one mass, got {1e3 * first.sensor_mass:g} ({first.place}) and "
            f"{1e3 * measured.sensor_mass:g} g"
        )


def _check_point(measured: MeasuredValue, rig: Rig) -> None:
    plate = rig.plate
    x, y = measured.point
    is_within_length = -_EDGE_TOLERANCE <= x <= plate.length + _EDGE_TOLERANCE
    is_within_width = -_EDGE_TOLERANCE <= y <= plate.width + _EDGE_TOLERANCE
    if not (is_within_length and is_within_width):
        raise InputError(
            f"{measured.place}: sensor {measured.sensor} must be on the rig's plate, from "
            f"(0, 0) to ({plate.length:g}, {plate.width:g}) m, got {_shown(measured.point)} m; "
            "check the plate and the unit"
        )


def _era_of(measured: MeasuredValue, rig: Rig) -> int:
    """Return the index of the driven ERA, found by name or else by position."""
    point = measured.era_point
    names = [era.name for era in rig.eras]
    for number, era in enumerate(rig.eras):
        is_near = point is not None and math.dist(point, (era.x, era.y)) <= _ERA_TOLERANCE
        if era.name == measured.era:
            if point is not None and not is_near:
                raise InputError(
                    f"{measured.place}: ERA {era.name} must be at {_shown((era.x, era.y))} m, its "
                    f"position in the rig, got {_shown(point)} m; check the plate"
                )
            return number
        if is_near and measured.era not in names:
            return number
    positions = ", ".join(f"{era.name} {_shown((era.x, era.y))}" for era in rig.eras)
    unknown = measured.era or _shown(point or (0, 0))
    raise InputError(f"{measured.place}: ERA must be one of {positions}, got {unknown}")


def _shown(point: tuple[float, float]) -> str:
    return f"({point[0]:g}, {point[1]:g})"


def read_measured(path: Path) -> list[MeasuredValue]:
    """Read measured responses; raises InputError with file and line."""
    suffix = path.suffix.lower()
    if suffix == ".csv":
        return _read_csv(path)
    if suffix in (".uff", ".unv"):
        return _read_uff(path)
    raise InputError(f"{path}: name of measured responses must end in .csv, .uff or .unv")


def write_responses(path: Path, measurement: Measurement, rig: Rig, *, setting: str = "") -> None:
    """Write responses as CSV or UFF by the name's ending; setting: as `MeasuredValue`.

    Raises OSError.
    """
    if path.suffix.lower() == ".csv":
        write_responses_csv(path, measurement, rig, setting=setting)
    else:
        write_responses_uff(path, measurement, rig, setting=setting)


def write_responses_csv(
    path: Path, measurement: Measurement, rig: Rig, *, setting: str = ""
) -> None:
    """Write responses as CSV with all digits.

    Raises OSError; InputError for a rig with both ERAs and exciters, whose units differ.
    """
    units = {era.UNIT for era in rig.eras}
    if len(units) > 1:
        raise InputError(f"{path}: ERAs and exciters need a .uff file, whose functions have units")
    real, imaginary = _PER_VOLT if "V" in units else COLUMNS[-2:]
    measured = measurement.values.swapaxes(1, 2)
    f, e, s = np.nonzero(np.isfinite(measured))
    values = measured[f, e, s]
    points = measurement.points[s]
    eras = [rig.eras[number] for number in e]
    columns: dict[str, Column] = {
        "era": [era.name for era in eras],
        "era_x_m": [era.x for era in eras],
        "era_y_m": [era.y for era in eras],
        "sensor": [measurement.names[number] for number in s],
        "x_m": points[:, 0],
        "y_m": points[:, 1],
        "frequency_hz": measurement.frequencies[f],
        real: values.real,
        imaginary: values.imag,
    }
    masses = np.array([sensor.mass for sensor in measurement.sensors])
    if masses.any():
        columns[_MASS] = 1e3 * masses[s]
    if setting:
        columns[SETTING] = [setting] * len(s)
    write_columns(path, columns)


def write_responses_uff(
    path: Path, measurement: Measurement, rig: Rig, *, setting: str = ""
) -> None:
    """Write responses as UFF 58: nodes from 1 are sensors, nodes from 1001 ERAs; raises OSError."""
    nodes = {}
    for number, sensor in enumerate(measurement.sensors, start=1):
        nodes[number] = (sensor.x, sensor.y, 0.0)
    functions = []
    for e, era in enumerate(rig.eras):
        nodes[_FIRST_ERA_NODE + e] = (era.x, era.y, 0.0)
        data_type = DISPLACEMENT if era.UNIT == "m" else _GENERAL
        for s, sensor in enumerate(measurement.sensors):
            values = measurement.values[:, s, e]
            measured = np.isfinite(values)
            note = ""
            if setting or sensor.mass:
                note = f"{_MASS}={1e3 * sensor.mass:.10g} {SETTING}={setting}"
            if measured.any():
                functions.append(
                    Function(
                        place=str(path),
                        function_type=FREQUENCY_RESPONSE,
                        response=s + 1,
                        reference=_FIRST_ERA_NODE + e,
                        names=(sensor.name, era.name),
                        directions=(_UP, _UP),
                        x=measurement.frequencies[measured],
                        data=values[measured],
                        data_types=(UFF_FREQUENCY, ACCELERATION, data_type),
                        units=("m/s^2", era.UNIT),
                        note=note,
                    )
                )
    write_universal(path, Universal(nodes, functions))


def _read_csv(path: Path) -> list[MeasuredValue]:
    optional = (*ERA_COLUMNS, _MASS, SETTING)
    lines = read_lines(path, COLUMNS, optional=optional, instead=_PER_VOLT)
    return [_csv_value(path, line) for line in lines]


def _csv_value(path: Path, line: CsvLine) -> MeasuredValue:
    era_numbers = [line.number(name) for name in ERA_COLUMNS if name in line.cells]
    if len(era_numbers) == 1:
        raise InputError(f"{path}:1: {' and '.join(ERA_COLUMNS)} must be given together")
    is_per_volt = _PER_VOLT[0] in line.cells
    real, imaginary = _PER_VOLT if is_per_volt else COLUMNS[-2:]
    point = (line.number("x_m"), line.number("y_m"))
    frequency = line.number("frequency_hz")
    value = complex(line.number(real), line.number(imaginary))
    era = line.cells["era"]
    sensor = line.cells["sensor"]
    if not (era and sensor):
        raise InputError(f"{line.place}: era and sensor must have names")
    if frequency < 0:
        raise InputError(f"{line.place}: frequency_hz must be 0 or more, got {frequency:g}")
    return MeasuredValue(
        era=era,
        sensor=sensor,
        point=point,
        era_point=(era_numbers[0], era_numbers[1]) if era_numbers else None,
        frequency=frequency,
        value=value,
        place=line.place,
        sensor_mass=sensor_mass(line.place, line.number(_MASS, 0.0)),
        setting=line.cells.get(SETTING, ""),
        is_per_volt=is_per_volt,
    )


def _read_uff(path: Path) -> list[MeasuredValue]:
    content = read_universal(path)
    functions = [f for f in content.functions if f.function_type == FREQUENCY_RESPONSE]
    if not functions:
        raise InputError(
            f"{path}: file must have frequency responses (dataset 58, function type 4), got none; "
            "export acceleration over the base displacement of an ERA"
        )
    nodes: dict[str, set[int]] = {}
    for function in functions:
        name, _ = function.names
        nodes.setdefault(name, set()).add(function.response)
    measured = []
    for function in functions:
        measured += _uff_values(function, content, nodes)
    return measured


def _uff_values(
    function: Function, content: Universal, nodes: dict[str, set[int]]
) -> list[MeasuredValue]:
    """Return the values of a function; nodes: of the sensors, by name."""
    place = function.place
    is_per_volt = _is_per_volt(function)
    scale = _unit(place, function.units[0], _ACCELERATION_UNITS)
    if not is_per_volt:
        scale /= _unit(place, function.units[1], _DISPLACEMENT_UNITS)
    hertz = _unit(place, function.abscissa_unit, _FREQUENCY_UNITS)
    _check_function(function, content)
    for direction in function.directions:
        if direction < 0:
            scale = -scale
    sensor, era = function.names
    if not sensor or len(nodes[sensor]) > 1:
        sensor = f"{sensor or 'node'}:{function.response}"
    x, y, _ = map(float, content.nodes[function.response])
    era_point = None
    if function.reference in content.nodes:
        era_x, era_y, _ = map(float, content.nodes[function.reference])
        era_point = (era_x, era_y)
    mass, setting = _noted(function)
    measured = []
    for frequency, value in zip(function.x.tolist(), function.data.tolist(), strict=True):
        measured.append(
            MeasuredValue(
                era=era,
                sensor=sensor,
                point=(x, y),
                era_point=era_point,
                frequency=hertz * frequency,
                value=scale * value,
                place=place,
                sensor_mass=mass,
                setting=setting,
                is_per_volt=is_per_volt,
            )
        )
    return measured


def _is_per_volt(function: Function) -> bool:
    """Whether a function is per volt; raises InputError for another quantity."""
    _, response_type, reference_type = function.data_types
    is_per_volt = reference_type == _GENERAL and function.units[1].lower() == "v"
    if response_type != ACCELERATION or not (is_per_volt or reference_type == DISPLACEMENT):
        raise InputError(
            f"{function.place}: data types must be acceleration ({ACCELERATION}) over displacement "
            f"({DISPLACEMENT}) of an ERA's base, or over volts ({_GENERAL}, in V) of an exciter, "
            f"got {response_type} over {reference_type}"
        )
    return is_per_volt


def _check_function(function: Function, content: Universal) -> None:
    """Raise InputError for a function without phases, direction or position."""
    place = function.place
    if not np.iscomplexobj(function.data):
        raise InputError(f"{place}: response must be complex, got real; export it with phases")
    if any(abs(direction) not in (0, _UP) for direction in function.directions):
        raise InputError(
            f"{place}: directions must be across the plate (3 or -3, z), got "
            f"{function.directions[0]} and {function.directions[1]}"
        )
    if function.response not in content.nodes:
        raise InputError(
            f"{place}: node {function.response} must have a position; export nodes too (dataset 15 "
            "or 2411)"
        )


def _unit(place: str, label: str, units: Mapping[str, float]) -> float:
    """Return the SI value of the unit with a given label; raises InputError."""
    plain = label.lower().translate(_SPELLED).replace("sec", "s")
    if plain not in units:
        spelled = ", ".join(filter(None, units))
        raise InputError(f"{place}: unit must be one of {spelled}, got {label!r}; export it so")
    return units[plain]


def _noted(function: Function) -> tuple[float, str]:
    """Return sensor mass [kg] and setting from the free text of a function; raises InputError."""
    note = _NOTE.search(function.note)
    if note is None:
        return 0.0, ""
    try:
        mass = float(note["mass"])
    except ValueError:
        mass = math.nan
    return sensor_mass(function.place, mass), (note["setting"] or "").strip()


def sensor_mass(place: str, grams: float, *, column: str = _MASS) -> float:
    """Convert a sensor's mass from grams in a column to [kg]; raises InputError."""
    if not 0 <= grams <= MAX_SENSOR_MASS:  # nor for NaN
        raise InputError(
            f"{place}: {column} must be from 0 to {MAX_SENSOR_MASS:g}, got {grams:g}; it is in "
            "grams"
        )
    return grams / 1e3


def read_places(path: Path, plate: Plate) -> dict[str, Point]:
    """Read positions of sensors [m] on a plate by name; raises InputError with file and line."""
    places: dict[str, Point] = {}
    for line in read_lines(path, PLACE_COLUMNS, optional=INPUT_COLUMNS):
        name, point = named_place(line, places, plate)
        places[name] = point
    return places


def named_place(line: CsvLine, names: Collection[str], plate: Plate) -> tuple[str, Point]:
    """Return name and position of a sensor; raises InputError for a name among earlier names."""
    name = line.cells["sensor"]
    if not name or name in names:
        raise InputError(f"{line.place}: sensor must be a name that no other has, got {name!r}")
    point = (line.number("x_m"), line.number("y_m"))
    check_on_plate(f"{line.place}: sensor {name}", [point], plate)
    return name, point
