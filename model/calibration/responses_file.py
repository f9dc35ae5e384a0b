"""Files of measured frequency responses: CSV with named columns, and UFF 58.

A CSV file has exactly the columns below and one value a line, in any order. A UFF file has a
function of type 4 for every sensor and ERA, acceleration over displacement, with the nodes'
positions in dataset 15 or 2411; the reference node is the ERA, by its name or position.
"""

import csv
import io
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from model.calibration.responses import MeasuredValue, Responses
from model.errors import InputError
from model.files.csv_file import write_columns
from model.files.uff import (
    ACCELERATION,
    DISPLACEMENT,
    FREQUENCY,
    FREQUENCY_RESPONSE,
    Function,
    Universal,
    read_bytes,
    read_universal,
    write_universal,
)
from model.rig.rig import Rig

COLUMNS = ("era", "sensor", "x_m", "y_m", "frequency_hz", "real_1_s2", "imag_1_s2")
ERA_COLUMNS = ("era_x_m", "era_y_m")  # optional
_UP = 3  # +z
_MAX_NAMED = 3  # unknown columns in an error
# Labels of m/s² and m without punctuation.
_ACCELERATION_UNITS = ("", "m/s2", "m/sec2", "m/ss", "ms-2", "ms2")
_DISPLACEMENT_UNITS = ("", "m", "meter", "metre")


def read_measured(path: Path) -> list[MeasuredValue]:
    """Read measured responses; raises InputError with file and line."""
    suffix = path.suffix.lower()
    if suffix == ".csv":
        return _read_csv(path)
    if suffix in (".uff", ".unv"):
        return _read_uff(path)
    raise InputError(f"{path}: name of measured responses must end in .csv, .uff or .unv")


def write_responses_csv(path: Path, responses: Responses, rig: Rig) -> None:
    """Write responses as CSV with all digits; raises OSError."""
    f, e, s = np.nonzero(np.isfinite(responses.values))
    values = responses.values[f, e, s]
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
            "real_1_s2": values.real,
            "imag_1_s2": values.imag,
        },
    )


def write_responses_uff(path: Path, responses: Responses, rig: Rig) -> None:
    """Write responses as UFF 58: nodes 1.. are the sensors, 1001.. the ERAs; raises OSError."""
    positions = [*responses.points.tolist(), *([era.x, era.y] for era in rig.eras)]
    numbers = [*range(1, len(responses.sensors) + 1), *range(1001, 1001 + len(rig.eras))]
    functions = []
    for e, era in enumerate(rig.eras):
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
                        (FREQUENCY, ACCELERATION, DISPLACEMENT),
                        ("m/s^2", "m"),
                    )
                )
    nodes = {n: (x, y, 0.0) for n, (x, y) in zip(numbers, positions, strict=True)}
    write_universal(path, Universal(nodes, functions))


def _read_csv(path: Path) -> list[MeasuredValue]:
    try:
        text = read_bytes(path).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: text must be UTF-8; save it as CSV in UTF-8") from error
    rows = csv.reader(io.StringIO(text), strict=True)
    found = []
    try:
        header = [name.strip() for name in next(rows)]
        _check_header(path, header)
        numeric = [*COLUMNS[2:], *(name for name in ERA_COLUMNS if name in header)]
        for row in rows:
            if not row:
                continue
            line = rows.line_num
            if len(row) != len(header):
                raise InputError(
                    f"{path}:{line}: line must have {len(header)} values as the first line has, "
                    f"got {len(row)}; the file is damaged"
                )
            cell = dict(zip(header, row, strict=True))
            x, y, frequency, real, imaginary, *at_era = (
                _number(path, line, name, cell[name]) for name in numeric
            )
            era, sensor = cell["era"].strip(), cell["sensor"].strip()
            if not (era and sensor):
                raise InputError(f"{path}:{line}: era and sensor must have names")
            if frequency <= 0:
                raise InputError(f"{path}:{line}: frequency_hz must be positive, got {frequency:g}")
            era_point = (at_era[0], at_era[1]) if at_era else None
            value = complex(real, imaginary)
            place = f"{path}:{line}"
            found.append(MeasuredValue(era, sensor, (x, y), era_point, frequency, value, place))
    except csv.Error as error:
        raise InputError(
            f"{path}:{rows.line_num}: invalid CSV ({error}); check quotes and the end of the file"
        ) from error
    if not found:
        raise InputError(f"{path}:1: at least one line of values must follow, got none")
    return found


def _check_header(path: Path, header: Sequence[str]) -> None:
    missing = [name for name in COLUMNS if name not in header]
    unknown = [name for name in header if name not in (*COLUMNS, *ERA_COLUMNS)]
    if missing or unknown or len(set(header)) < len(header):
        problems = [f"{', '.join(missing)} missing"] if missing else []
        more = f" and {len(unknown) - _MAX_NAMED} more" if len(unknown) > _MAX_NAMED else ""
        named = ", ".join(repr(name[:30]) for name in unknown[:_MAX_NAMED])
        problems += [f"{named}{more} unknown"] if unknown else []
        problems += ["a column is repeated"] if not problems else []
        raise InputError(
            f"{path}:1: columns must be {', '.join(COLUMNS)}, optionally {', '.join(ERA_COLUMNS)}, "
            f"got {'; '.join(problems)}"
        )
    if sum(name in header for name in ERA_COLUMNS) == 1:
        raise InputError(f"{path}:1: {' and '.join(ERA_COLUMNS)} must be given together")


def _number(path: Path, line: int, name: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise InputError(f"{path}:{line}: {name} must be a finite number, got {text[:30]!r}")
    return value


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
    if function.data_types[1] != ACCELERATION or function.data_types[2] != DISPLACEMENT:
        raise InputError(
            f"{place}: data types must be acceleration ({ACCELERATION}) over displacement "
            f"({DISPLACEMENT}) of an ERA's base, got {function.data_types[1]} over "
            f"{function.data_types[2]}"
        )
    for label, known, wanted in (
        (function.units[0], _ACCELERATION_UNITS, "m/s²"),
        (function.units[1], _DISPLACEMENT_UNITS, "m"),
    ):
        plain = label.lower().translate({ord("²"): "2", ord("^"): None, ord("*"): None})
        if plain.replace(" ", "") not in known:
            raise InputError(f"{place}: unit must be {wanted}, got {label!r}; export it so")
    if not np.iscomplexobj(function.data):
        raise InputError(f"{place}: response must be complex, got real; export it with phases")
    if any(abs(direction) not in (0, _UP) for direction in function.directions):
        raise InputError(
            f"{place}: directions must be across the plate (3 or -3, z), got "
            f"{function.directions[0]} and {function.directions[1]}"
        )
    if function.x[0] <= 0:
        raise InputError(
            f"{place}: frequencies must be positive, got {function.x[0]:g} Hz; leave it out"
        )
    if function.response not in content.nodes:
        raise InputError(
            f"{place}: node {function.response} must have a position; export nodes too (dataset 15 "
            "or 2411)"
        )
    name, reference = function.names[0], content.nodes.get(function.reference)
    if not name or len(named[name]) > 1:
        name = f"{name or 'node'}:{function.response}"
    sign = math.prod(-1 if direction < 0 else 1 for direction in function.directions)
    x, y, _ = content.nodes[function.response]
    era_point = None if reference is None else (float(reference[0]), float(reference[1]))
    return [
        MeasuredValue(
            function.names[1], name, (float(x), float(y)), era_point, frequency, sign * value, place
        )
        for frequency, value in zip(function.x.tolist(), function.data.tolist(), strict=True)
    ]
