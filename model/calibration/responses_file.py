"""Files of measured frequency responses: CSV with named columns, and UFF 58.

A CSV file has exactly the columns below and one value a line, in any order. A UFF file has a
function of type 4 for every sensor and ERA, acceleration over displacement, with the nodes'
positions in dataset 15 or 2411; the reference node is the ERA, by its name or position.

Responses to exciters are per volt: in columns `real_m_s2_v` and `imag_m_s2_v`, or in functions
whose reference is of no type of its own (1), in V.

The mass of a sensor that is moved and the setting of a measurement are in columns of their own, or
in the second line of free text of a function: `sensor_mass_g=2 setting=level 0.1`.
"""

import math
import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from model.calibration.responses import MeasuredValue, Responses
from model.errors import InputError
from model.files.csv_file import Column, read_lines, write_columns
from model.files.uff import (
    ACCELERATION,
    DISPLACEMENT,
    FREQUENCY,
    FREQUENCY_RESPONSE,
    Function,
    Universal,
    read_bytes,
    read_universal,
    text_of,
    write_universal,
)
from model.rig.rig import Rig

COLUMNS = ("era", "sensor", "x_m", "y_m", "frequency_hz", "real_1_s2", "imag_1_s2")
_PER_VOLT = ("real_m_s2_v", "imag_m_s2_v")
ERA_COLUMNS = ("era_x_m", "era_y_m")  # optional
MASS, SETTING = "sensor_mass_g", "setting"  # optional, too
_NOTE = re.compile(rf"\b{MASS}=(?P<mass>\S+)(?:\s+{SETTING}=(?P<setting>.*))?")
MAX_SENSOR_MASS = 500.0
"""g; of a sensor that is moved. One that weighs more is no accelerometer."""

_UP = 3  # +z
_GENERAL = 1  # a data type without one of its own
# SI units by label, without blanks, brackets, powers' signs and the dot of abbreviations.
_ACCELERATION_UNITS = {
    **dict.fromkeys(("", "m/s2", "m/s/s", "m/ss", "ms-2", "ms2", "meter/s2"), 1.0),
    **dict.fromkeys(("mm/s2", "mm/s/s"), 1e-3),
    **dict.fromkeys(("g", "gs", "gn", "g0"), 9.80665),
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


def read_measured(path: Path) -> list[MeasuredValue]:
    """Read measured responses; raises InputError with file and line."""
    suffix = path.suffix.lower()
    if suffix == ".csv":
        return _read_csv(path)
    if suffix in (".uff", ".unv"):
        return _read_uff(path)
    raise InputError(f"{path}: name of measured responses must end in .csv, .uff or .unv")


def write_responses(path: Path, responses: Responses, rig: Rig, *, setting: str = "") -> None:
    """Write responses as CSV or UFF by the name's ending; setting: as `MeasuredValue`.

    Raises OSError.
    """
    write = write_responses_csv if path.suffix.lower() == ".csv" else write_responses_uff
    write(path, responses, rig, setting=setting)


def write_responses_csv(path: Path, responses: Responses, rig: Rig, *, setting: str = "") -> None:
    """Write responses as CSV with all digits.

    Raises OSError; InputError for ERAs beside exciters, whose units differ.
    """
    units = {era.UNIT for era in rig.eras}
    if len(units) > 1:
        raise InputError(f"{path}: ERAs and exciters need a .uff file, whose functions have units")
    real, imaginary = _PER_VOLT if "V" in units else COLUMNS[-2:]
    f, e, s = np.nonzero(np.isfinite(responses.values))
    values = responses.values[f, e, s]
    further: dict[str, Column] = {}
    if responses.masses is not None:
        further[MASS] = 1e3 * responses.masses[s]
    if setting:
        further[SETTING] = [setting] * len(s)
    write_columns(
        path,
        {
            "era": [rig.eras[number].name for number in e],
            "era_x_m": [rig.eras[number].x for number in e],
            "era_y_m": [rig.eras[number].y for number in e],
            "sensor": [responses.sensors[number] for number in s],
            "x_m": responses.points[s, 0],
            "y_m": responses.points[s, 1],
            "frequency_hz": responses.frequencies[f],
            real: values.real,
            imaginary: values.imag,
            **further,
        },
    )


def write_responses_uff(path: Path, responses: Responses, rig: Rig, *, setting: str = "") -> None:
    """Write responses as UFF 58: nodes 1.. are the sensors, 1001.. the ERAs; raises OSError."""
    masses = responses.sensor_masses
    notes = [f"{MASS}={1e3 * mass:.10g} {SETTING}={setting}" for mass in masses]
    positions = [*responses.points.tolist(), *([era.x, era.y] for era in rig.eras)]
    numbers = [*range(1, len(responses.sensors) + 1), *range(1001, 1001 + len(rig.eras))]
    functions = []
    for e, era in enumerate(rig.eras):
        reference = (DISPLACEMENT if era.UNIT == "m" else _GENERAL, era.UNIT)
        for s, sensor in enumerate(responses.sensors):
            measured = np.isfinite(responses.values[:, e, s])
            if measured.any():
                functions.append(
                    Function(
                        str(path),
                        FREQUENCY_RESPONSE,
                        s + 1,
                        1001 + e,
                        (sensor, era.name),
                        (_UP, _UP),
                        responses.frequencies[measured],
                        responses.values[measured, e, s],
                        (FREQUENCY, ACCELERATION, reference[0]),
                        ("m/s^2", reference[1]),
                        note=notes[s] if setting or masses[s] else "",
                    )
                )
    nodes = {n: (x, y, 0.0) for n, (x, y) in zip(numbers, positions, strict=True)}
    write_universal(path, Universal(nodes, functions))


def _read_csv(path: Path) -> list[MeasuredValue]:
    found = []
    header = text_of(path, read_bytes(path)).lstrip().partition("\n")[0]
    is_per_volt = _PER_VOLT[0] in header
    columns = (*COLUMNS[:-2], *(_PER_VOLT if is_per_volt else COLUMNS[-2:]))
    for line in read_lines(path, columns, optional=(*ERA_COLUMNS, MASS, SETTING)):
        at_era = [line.number(name) for name in ERA_COLUMNS if name in line.cells]
        if len(at_era) == 1:
            raise InputError(f"{path}:1: {' and '.join(ERA_COLUMNS)} must be given together")
        x, y, frequency, real, imaginary = map(line.number, columns[2:])
        era, sensor = line.cells["era"], line.cells["sensor"]
        if not (era and sensor):
            raise InputError(f"{line.place}: era and sensor must have names")
        if frequency < 0:
            raise InputError(f"{line.place}: frequency_hz must be 0 or more, got {frequency:g}")
        era_point = (at_era[0], at_era[1]) if at_era else None
        value = complex(real, imaginary)
        mass, setting = line.number(MASS, 0.0), line.cells.get(SETTING, "")
        found.append(
            MeasuredValue(
                era,
                sensor,
                (x, y),
                era_point,
                frequency,
                value,
                line.place,
                sensor_mass(line.place, mass),
                setting,
                is_per_volt,
            )
        )
    return found


def _read_uff(path: Path) -> list[MeasuredValue]:
    content = read_universal(path)
    functions = [f for f in content.functions if f.function_type == FREQUENCY_RESPONSE]
    if not functions:
        raise InputError(
            f"{path}: file must have frequency responses (dataset 58, function type 4), got none; "
            "export acceleration over the base displacement of an ERA"
        )
    named: dict[str, set[int]] = {}
    for function in functions:
        named.setdefault(function.names[0], set()).add(function.response)
    return [value for function in functions for value in _uff_values(function, content, named)]


def _uff_values(
    function: Function, content: Universal, named: dict[str, set[int]]
) -> list[MeasuredValue]:
    place = function.place
    is_per_volt = function.data_types[2] == _GENERAL and function.units[1].lower() == "v"
    is_known = is_per_volt or function.data_types[2] == DISPLACEMENT
    if function.data_types[1] != ACCELERATION or not is_known:
        raise InputError(
            f"{place}: data types must be acceleration ({ACCELERATION}) over displacement "
            f"({DISPLACEMENT}) of an ERA's base, or over volts ({_GENERAL}, in V) of an exciter, "
            f"got {function.data_types[1]} over {function.data_types[2]}"
        )
    scale = _unit(place, function.units[0], _ACCELERATION_UNITS)
    if not is_per_volt:
        scale /= _unit(place, function.units[1], _DISPLACEMENT_UNITS)
    hertz = _unit(place, function.abscissa_unit, _FREQUENCY_UNITS)
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
    name, reference = function.names[0], content.nodes.get(function.reference)
    if not name or len(named[name]) > 1:
        name = f"{name or 'node'}:{function.response}"
    scale *= math.prod(-1 if direction < 0 else 1 for direction in function.directions)
    x, y, _ = content.nodes[function.response]
    mass, setting = _noted(function)
    era_point = None if reference is None else (float(reference[0]), float(reference[1]))
    return [
        MeasuredValue(
            function.names[1],
            name,
            (float(x), float(y)),
            era_point,
            hertz * frequency,
            scale * value,
            place,
            mass,
            setting,
            is_per_volt,
        )
        for frequency, value in zip(function.x.tolist(), function.data.tolist(), strict=True)
    ]


def _unit(place: str, label: str, known: Mapping[str, float]) -> float:
    """The value of a unit by its label in SI units; raises InputError."""
    plain = label.lower().translate(_SPELLED).replace("sec", "s")
    if plain not in known:
        spelled = ", ".join(filter(None, known))
        raise InputError(f"{place}: unit must be one of {spelled}, got {label!r}; export it so")
    return known[plain]


def _noted(function: Function) -> tuple[float, str]:
    """Mass of the sensor [kg] and setting by the free text of a function; raises InputError."""
    found = _NOTE.search(function.note)
    if found is None:
        return 0.0, ""
    try:
        mass = float(found["mass"])
    except ValueError:
        mass = math.nan
    return sensor_mass(function.place, mass), (found["setting"] or "").strip()


def sensor_mass(place: str, grams: float, *, column: str = MASS) -> float:
    """A sensor's mass [kg] from grams in a column; raises InputError."""
    if not 0 <= grams <= MAX_SENSOR_MASS:  # nor for NaN
        raise InputError(
            f"{place}: {column} must be from 0 to {MAX_SENSOR_MASS:g}, got {grams:g}; it is in "
            "grams"
        )
    return grams / 1e3
