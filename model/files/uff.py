"""Universal files (UFF): functions at nodes (dataset 58), nodes (15, 2411) and units (164).

The format of modal analysis since the 1970s, ASCII or binary, with fields as in pyuff. pyuff skips
over damage and knows one spelling of numbers, so datasets are cut and numbers read here.
"""

import math
import re
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from model.arrays import FloatArray
from model.errors import MAX_VALUE, InputError
from model.files.array_file import whole_or_nothing
from registry.files import read_regular

TIME_RESPONSE, FREQUENCY_RESPONSE = 1, 4  # function types
DISPLACEMENT, ACCELERATION, TIME, FREQUENCY = 8, 12, 17, 18  # data types

_UTF_16 = (b"\xff\xfe", b"\xfe\xff")
BYTE_ORDER_MARKS = (b"\xef\xbb\xbf", *_UTF_16)

_MAX_BYTES = 512 << 20
_READ = (15, 58, 164, 2411)
_HEADER_LINES = 12  # of dataset 58, its number first
_ID_LINES = 5  # of these, free text
_NOTE = 2  # of these, see `Function`
_FORM = 7  # of these, that of the data: kind, count, abscissa
_SI = 1  # units code of dataset 164
_NOT_METRES = (2, 4, 5, 6, 7, 8, 10)  # such codes: feet, millimetres, centimetres, inches
_MARK = re.compile(rb"^ {4}-1[ \t]*(?:\r?\n|\r|\Z)", re.MULTILINE)
_BINARY_END = re.compile(rb" {4}-1[ \t]*(?:\r?\n|\r|\Z)")  # no line end before it
_HEADER = re.compile(
    rb"[ \t]*(?P<kind>\d{1,9})(?!\d)"
    rb"(?:(?P<binary>[bB])(?:\s*\d+){3}[ \t]+(?P<bytes>\d{1,18})(?!\d))?[^\r\n]*"
)
# As Fortran writes them: they may touch, with D for E, or without a letter.
_NUMBER = re.compile(
    rb"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eEdD][-+]?\d+|[-+]\d{2,3}(?![\d.]))?|[-+]?\b(?:[nN]a[nN]|[iI]nf\w*)\b"
)
_NO_LETTER = re.compile(rb"(?<=[\d.])(?=[-+])")


@dataclass(frozen=True, eq=False)
class Function:
    """One dataset 58: a function between a response node and a reference node."""

    place: str
    """File and line, for errors."""

    function_type: int
    response: int
    reference: int
    names: tuple[str, str]
    """Names of both nodes, "" without one."""

    directions: tuple[int, int]
    """Directions at both nodes, +-3 for +-z."""

    x: FloatArray
    """Abscissa (n,)."""

    data: NDArray[Any]
    """Ordinate (n,), real or complex."""

    data_types: tuple[int, int, int]
    """Codes of abscissa, ordinate and denominator."""

    units: tuple[str, str]
    """Labels of the units of ordinate and denominator."""

    abscissa_unit: str = ""
    """Label of the unit of the abscissa, as a file has it."""

    note: str = ""
    """The second line of free text, up to 80 characters."""


@dataclass(frozen=True, eq=False)
class Universal:
    """Content of a universal file."""

    nodes: Mapping[int, tuple[float, float, float]]
    """x, y, z [m] by number."""

    functions: Sequence[Function]


def write_universal(path: Path, content: Universal) -> None:
    """Write nodes, units and functions in ASCII, double precision (12 digits), atomically.

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
    sets = [units | factors, nodes, *(_as_58(function) for function in content.functions)]
    with whole_or_nothing(path) as stream:  # raises OSError, which pyuff would hide
        pyuff.UFF(stream.name).write_sets(sets, "overwrite")


def read_universal(path: Path) -> Universal:
    """Read a file; raises InputError with file and line if it is damaged or of another format.

    Of each record the numbers that its header counts. pyuff reads the headers, nodes and units, of
    a copy in which nothing else can be taken for them.
    """
    import pyuff

    wanted = [each for each in blocks(path, read_bytes(path)) if each.kind in _READ]
    nodes: dict[int, tuple[float, float, float]] = {}
    functions, length = [], 1.0
    with tempfile.TemporaryDirectory(prefix="era-") as folder:
        copy = Path(folder) / "copy.uff"
        copy.write_bytes(b"".join(each.plain for each in wanted))
        file = pyuff.UFF(str(copy))
        for number, block in enumerate(wanted):
            place = f"{path}:{block.line}"
            try:
                found = file.read_sets(number, header_only=True)
                if block.kind == 58:
                    functions.append(_function(path, block, found))
                elif block.kind == 164:
                    label = found["units_description"]
                    code = int(found["units_code"])
                    length = lengths_in_si(place, float(found["length"]), code, label)
                else:
                    xyz = zip(found["x"], found["y"], found["z"], strict=True)
                    nodes.update(zip(map(int, found["node_nums"]), xyz, strict=True))
            except InputError:
                raise
            except Exception as error:  # pyuff raises nothing narrower
                raise InputError(
                    f"{place}: dataset {block.kind} cannot be read; export it again"
                ) from error
    return Universal(
        {n: (x / length, y / length, z / length) for n, (x, y, z) in nodes.items()}, functions
    )


def text_of(path: Path, content: bytes) -> str:
    """The text of a measured file in UTF-8, or UTF-16 with a mark; raises InputError."""
    try:
        text = content.decode("utf-16" if content.startswith(_UTF_16) else "utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: text must be UTF-8; save it as such") from error
    if "\0" in text:
        raise InputError(f"{path}: file must be text in UTF-8, got zero bytes; export it as such")
    return text


def read_bytes(path: Path) -> bytes:
    """Read a measured file; raises InputError if it is missing, empty or too large."""
    try:
        content = read_regular(path, _MAX_BYTES)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error
    if not content.strip():
        raise InputError(f"{path}: file is empty; export the measurement again")
    return content


@dataclass(frozen=True)
class DatasetBlock:
    """One dataset: the line of its opening mark, its number, the content between its marks."""

    line: int
    kind: int
    is_binary: bool
    content: bytes

    @property
    def rows(self) -> list[bytes]:
        """Lines of text, with the number of the dataset first."""
        return self.content.splitlines()

    @property
    def plain(self) -> bytes:
        """The dataset as pyuff reads it, without free text and the numbers of a record."""
        rows = self.rows
        if self.kind == 58:
            rows += [b""] * (_HEADER_LINES - len(rows))
            rows[_FORM] = rows[_FORM].upper().replace(b"D", b"E")
            rows = [rows[0], *[b"NONE"] * _ID_LINES, *rows[1 + _ID_LINES : _HEADER_LINES]]
        elif self.kind != 164:  # a node's number must not be taken for a mark
            rows = [rows[0], *(b" " + b" ".join(row.split()) for row in rows[1:])]
        text = b"\n".join(rows)
        try:
            text.decode()
        except UnicodeDecodeError:
            text = text.decode("latin-1").encode()
        return b"    -1\n" + text + b"\n    -1\n"


def blocks(path: Path, content: bytes) -> Iterator[DatasetBlock]:
    """Datasets of a file, between lines of `    -1` alone."""
    if content.startswith(BYTE_ORDER_MARKS):  # text, as an editor saved it
        content = text_of(path, content).encode()
    if b"\n" not in content:
        content = content.replace(b"\r", b"\n")
    start = _MARK.search(content)
    if start is None:
        raise InputError(
            f"{path}: a universal file must have lines of `    -1` alone, got none; export the "
            "measurement as UFF, datasets 58 with 15 or 2411"
        )
    while start is not None:
        line = content.count(b"\n", 0, start.start()) + 1
        begin = start.end()
        head = _HEADER.match(content, begin)
        if head is None:
            raise InputError(
                f"{path}:{line}: dataset must begin with its number, got none; export it again"
            )
        data = begin
        if head["binary"]:  # its numbers are any bytes
            for _ in range(_HEADER_LINES):
                data = content.find(b"\n", data) + 1 or len(content)
            data += int(head["bytes"] or 0)
        end = (_BINARY_END if head["binary"] else _MARK).search(content, data)
        if end is None:
            raise InputError(
                f"{path}:{line}: dataset has no end; the file was cut off, export it again"
            )
        kind = int(head["kind"])
        yield DatasetBlock(line, kind, bool(head["binary"]), content[begin : end.start()])
        start = _MARK.search(content, end.end())


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
        "id2": function.note or "NONE",
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


def _function(path: Path, block: DatasetBlock, found: Mapping[str, Any]) -> Function:
    place, count = f"{path}:{block.line}", int(found["num_pts"])
    is_complex, is_even = found["ord_data_type"] in (5, 6), found["abscissa_spacing"] == 1
    shape = (count, 1 + is_complex + (not is_even))
    read = _bytes_of if block.is_binary else _numbers_of
    values = read(path, block, found, math.prod(shape))
    if len(values) < math.prod(shape):
        raise InputError(
            f"{place}: record must have {math.prod(shape)} numbers, as its header says, got "
            f"{len(values)}; the file is damaged, export it again"
        )
    values = values.reshape(shape)
    if not (np.abs(values) <= MAX_VALUE).all():
        raise InputError(
            f"{place}: values of the record must be finite, up to {MAX_VALUE:g}; measure it again"
        )
    x = (
        found["abscissa_min"] + np.arange(count) * found["abscissa_inc"]
        if is_even
        else values[:, 0]
    )
    if count == 0 or not ((np.diff(x) > 0).all() and abs(x[-1]) <= MAX_VALUE):
        raise InputError(f"{place}: abscissa of the record must ascend; export it again")
    data = values[:, -2] + 1j * values[:, -1] if is_complex else values[:, -1]
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
        _name(found["abscissa_axis_units_lab"]),
        _name(block.rows[_NOTE].decode("utf-8", "replace")),
    )


def _bytes_of(path: Path, block: DatasetBlock, found: Mapping[str, Any], count: int) -> FloatArray:
    """So many numbers of a binary record, or all that it has."""
    data = block.content.split(b"\n", _HEADER_LINES)[-1]
    order = "<" if found["byte_ordering"] == 1 else ">"
    size = 8 if found["ord_data_type"] in (4, 6) else 4
    if data[count * size :].strip(b"\0 \t\r\n"):
        raise InputError(
            f"{path}:{block.line}: record must end behind {count} numbers, as its header says, got "
            f"{len(data) - count * size} bytes more; export it again, and copy it as a binary file"
        )
    whole = min(count, len(data) // size) * size
    return np.frombuffer(data[:whole], dtype=f"{order}f{size}").astype(float)


def _numbers_of(
    path: Path, block: DatasetBlock, found: Mapping[str, Any], count: int
) -> FloatArray:
    """So many numbers of a record in ASCII, or all; what fills their last line is left out."""
    numbers: list[float] = []
    for line, row in enumerate(block.rows[_HEADER_LINES:], start=block.line + 1 + _HEADER_LINES):
        if _NUMBER.sub(b"", row).strip() or (len(numbers) >= count and row.strip()):
            shown = row.decode("ascii", "backslashreplace").strip()[:40]
            raise InputError(
                f"{path}:{line}: data must be numbers, {count} in all, got {shown!r}; export the "
                "damaged file again"
            )
        numbers += numbers_in(row)
    return np.array(numbers[:count])


def numbers_in(row: bytes) -> list[float]:
    """All numbers of a row, in any spelling of Fortran."""
    words = (each.upper().replace(b"D", b"E") for each in _NUMBER.findall(row))
    return [float(_NO_LETTER.sub(b"E", word)) for word in words]


def lengths_in_si(place: str, length: float, code: int, label: str) -> float:
    """By what lengths of the file are divided to have metres; raises InputError."""
    if not 0 < length < math.inf or (length == 1 and code in _NOT_METRES):
        raise InputError(
            f"{place}: factor of lengths (dataset 164) must be positive and that of units code "
            f"{code} {label!r}, got {length:g}; export it in SI"
        )
    return length


def _name(text: str) -> str:
    plain = text.strip()
    return "" if plain.upper() == "NONE" else plain
