"""Universal files (UFF): functions at nodes (dataset 58), nodes (15, 2411) and units (164).

The format of modal analysis since the 1970s, ASCII or binary, with fields as in pyuff. pyuff skips
over damage, so datasets and numbers are checked here first. Files must be in SI units.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from model.arrays import FloatArray
from model.errors import InputError
from model.files.regular_file import regular_file

TIME_RESPONSE, FREQUENCY_RESPONSE = 1, 4  # function types
DISPLACEMENT, ACCELERATION, TIME, FREQUENCY = 8, 12, 17, 18  # data types

_MAX_BYTES = 512 << 20
_HEADER_LINES = 13  # of dataset 58, from its opening mark on
_SI = 1  # units code of dataset 164
# The mark between datasets: for pyuff, wherever a line ends in it. Only binary data may contain it;
# any other that is not a line of its own would shift all datasets after it.
_MARK = re.compile(rb"    -1(?=[\r\n]|\Z| {74}.)", re.DOTALL)
_DELIMITER = re.compile(rb"^    -1(?=[\r\n]|\Z| {74}.)", re.DOTALL | re.MULTILINE)


@dataclass(frozen=True, eq=False)
class Function:
    """One dataset 58.

    place: file and line, for errors; response, reference: nodes, each with a name ("" without one)
    and a direction, +-3 for +-z; x: abscissa, data (n,) real or complex; data_types: codes of
    abscissa, ordinate and denominator; units: labels of ordinate and denominator.
    """

    place: str
    function_type: int
    response: int
    reference: int
    names: tuple[str, str]
    directions: tuple[int, int]
    x: FloatArray
    data: NDArray[Any]
    data_types: tuple[int, int, int]
    units: tuple[str, str]


@dataclass(frozen=True, eq=False)
class Universal:
    """Content of a file. nodes: x, y, z [m] by number."""

    nodes: Mapping[int, tuple[float, float, float]]
    functions: Sequence[Function]


def write_universal(path: Path, content: Universal) -> None:
    """Write nodes, units and functions in ASCII, double precision (12 digits).

    An evenly spaced abscissa has six digits for its step. Raises OSError, and InputError for
    numbers that are not finite, for which pyuff would write zeros.
    """
    import pyuff

    if any(not np.isfinite(function.data).all() for function in content.functions):
        raise InputError(f"{path}: data of a universal file must be finite; leave out the others")
    count = len(content.nodes)
    x, y, z = np.array(list(content.nodes.values()), dtype=float).reshape(-1, 3).T
    zeros = np.zeros(count, dtype=int)
    units = {"type": 164, "units_code": _SI, "units_description": "SI", "temp_mode": 1}
    factors = {"length": 1.0, "force": 1.0, "temp": 1.0, "temp_offset": 0.0}
    nodes = {
        "type": 2411,
        "node_nums": np.array(list(content.nodes)),
        "def_cs": zeros,
        "disp_cs": zeros,
        "color": zeros,
        "x": x,
        "y": y,
        "z": z,
    }
    path.write_bytes(b"")  # raises OSError, which pyuff would hide
    sets = [units | factors, nodes, *(_as_58(function) for function in content.functions)]
    pyuff.UFF(str(path)).write_sets(sets, "overwrite")


def read_universal(path: Path) -> Universal:
    """Read a file; raises InputError with file and line if it is damaged or of another format."""
    import pyuff

    content = read_bytes(path)
    blocks = _blocks(path, content)
    file = pyuff.UFF(str(path))
    kinds = [int(kind) for kind in file.get_set_types()]
    nodes: dict[int, tuple[float, float, float]] = {}
    functions = []
    for number, (kind, (line, block)) in enumerate(zip(kinds, blocks, strict=True)):
        place = f"{path}:{line}"
        if kind not in (15, 58, 164, 2411):
            continue
        if kind == 58 and not _is_binary(block):
            _check_numbers(path, line, block)
        try:
            found = file.read_sets(number)
            if kind == 58:
                functions.append(_function(place, found))
            elif kind == 164:
                _check_si(place, found)
            else:
                xyz = zip(found["x"], found["y"], found["z"], strict=True)
                nodes.update(zip(map(int, found["node_nums"]), xyz, strict=True))
        except InputError:
            raise
        except Exception as error:  # pyuff raises nothing narrower
            raise InputError(f"{place}: dataset {kind} cannot be read; export it again") from error
    return Universal(nodes, functions)


def read_bytes(path: Path) -> bytes:
    """Read a measured file; raises InputError if it is missing, empty or too large."""
    try:
        with open(path, "rb", opener=regular_file) as stream:
            content = stream.read(_MAX_BYTES + 1)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error
    if not content.strip():
        raise InputError(f"{path}: file is empty; export the measurement again")
    if len(content) > _MAX_BYTES:
        raise InputError(f"{path}: size must be up to {_MAX_BYTES >> 20} MiB; export fewer records")
    return content


def _blocks(path: Path, content: bytes) -> list[tuple[int, bytes]]:
    """Line and content of each dataset, with its opening mark and without its closing one."""
    blocks, marks, end = [], set(), 0
    while start := _DELIMITER.search(content, end):
        line = content.count(b"\n", 0, start.start()) + 1
        mark = _MARK if _is_binary(content[start.start() : start.start() + 200]) else _DELIMITER
        stop = mark.search(content, start.end())
        if stop is None:
            raise InputError(
                f"{path}:{line}: dataset has no end; the file was cut off, export it again"
            )
        blocks.append((line, content[start.start() : stop.start()]))
        marks |= {start.start(), stop.start()}
        end = stop.end()
    if not blocks:
        raise InputError(
            f"{path}: a universal file must have lines of `    -1` alone, got none; export the "
            "measurement as UFF, datasets 58 with 15 or 2411"
        )
    for stray in _MARK.finditer(content):
        if stray.start() not in marks:
            line = content.count(b"\n", 0, stray.start()) + 1
            raise InputError(
                f"{path}:{line}: only lines between datasets may end in `    -1`; export it again "
                "with another number there, or binary data as ASCII"
            )
    return blocks


def _is_binary(block: bytes) -> bool:
    rows = block.split(b"\n", 2)
    return len(rows) > 1 and rows[1][6:7].lower() == b"b"


def _as_58(function: Function) -> dict[str, Any]:
    steps = np.diff(function.x)
    even = function.data_types[0] == TIME and len(steps) > 0 and np.ptp(steps) < 1e-6 * steps[0]
    return {
        "type": 58,
        "func_type": function.function_type,
        "rsp_node": function.response,
        "rsp_dir": function.directions[0],
        "ref_node": function.reference,
        "ref_dir": function.directions[1],
        "rsp_ent_name": function.names[0][:10] or "NONE",
        "ref_ent_name": function.names[1][:10] or "NONE",
        "id1": " / ".join(name for name in function.names if name) or "NONE",
        "abscissa_spacing": int(even),
        "abscissa_spec_data_type": function.data_types[0],
        "ordinate_spec_data_type": function.data_types[1],
        "orddenom_spec_data_type": function.data_types[2],
        "abscissa_axis_units_lab": "s" if function.data_types[0] == TIME else "Hz",
        "ordinate_axis_units_lab": function.units[0] or "NONE",
        "orddenom_axis_units_lab": function.units[1] or "NONE",
        "x": function.x,
        "data": function.data,
    }


def _function(place: str, found: Mapping[str, Any]) -> Function:
    x, data = np.asarray(found["x"], dtype=float), np.asarray(found["data"])
    if not len(data) == len(x) == found["num_pts"]:
        raise InputError(
            f"{place}: record must have {found['num_pts']} values, as its header says, got "
            f"{len(data)}; the file is damaged, export it again"
        )
    if not (np.isfinite(x).all() and np.isfinite(data).all()):
        raise InputError(f"{place}: values of the record must be finite; measure it again")
    if len(x) == 0 or (np.diff(x) <= 0).any():
        raise InputError(f"{place}: abscissa of the record must ascend; export it again")
    names = (_name(found["rsp_ent_name"]), _name(found["ref_ent_name"]))
    return Function(
        place,
        found["func_type"],
        found["rsp_node"],
        found["ref_node"],
        names,
        (found["rsp_dir"], found["ref_dir"]),
        x,
        data,
        tuple(found[f"{axis}_spec_data_type"] for axis in ("abscissa", "ordinate", "orddenom")),
        (_name(found["ordinate_axis_units_lab"]), _name(found["orddenom_axis_units_lab"])),
    )


def _name(text: str) -> str:
    plain = text.strip()
    return "" if plain.upper() == "NONE" else plain


def _check_si(place: str, found: Mapping[str, Any]) -> None:
    if found["units_code"] != _SI:
        raise InputError(
            f"{place}: units code (dataset 164) must be 1 (SI), got {found['units_code']} "
            f"{found['units_description']!r}; export it in SI"
        )


def _check_numbers(path: Path, line: int, block: bytes) -> None:
    """Raise InputError, with its line, for ASCII data that is not numbers."""
    rows = block.split(b"\n")
    for number, row in enumerate(rows[_HEADER_LINES:], start=line + _HEADER_LINES):
        try:
            # Numbers may touch: 1.00000e+00-1.00000e+00.
            for word in re.sub(rb"([eEdD][+-]?\d+)(?=[-+\d.])", rb"\1 ", row).split():
                float(word)
        except ValueError:
            shown = row.decode("ascii", "backslashreplace").strip()[:40]
            raise InputError(
                f"{path}:{number}: data must be numbers, got {shown!r}; export the "
                "damaged file again"
            ) from None
