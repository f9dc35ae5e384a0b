"""Universal files (UFF): functions at nodes (dataset 58), nodes (15, 2411) and units (164).

The format of modal analysis since the 1970s, ASCII or binary. Fields have the names of pyuff, which
writes files. It ignores damage and reads one spelling of numbers only, so files are read here.
"""

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from io import TextIOWrapper
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from model.arrays import FloatArray
from model.errors import MAX_VALUE, InputError
from model.files.array_file import whole_or_nothing
from registry.files import open_regular

FREQUENCY_RESPONSE = 4  # function type
DISPLACEMENT, ACCELERATION, UFF_TIME, UFF_FREQUENCY = 8, 12, 17, 18  # data types

_UTF_16 = (b"\xff\xfe", b"\xfe\xff")
BYTE_ORDER_MARKS = (b"\xef\xbb\xbf", *_UTF_16)

MAX_UFF_BYTES = 512 << 20
_HEADER_LINES = 12  # of dataset 58, its number first
_NOTE = 2  # of the note lines, see `Function`
# Header fields by name: line, first and last column, and conversion of the text.
_FIELDS = {
    "func_type": (6, 0, 5, int),
    "rsp_ent_name": (6, 31, 41, str),
    "rsp_node": (6, 41, 51, int),
    "rsp_dir": (6, 51, 55, int),
    "ref_ent_name": (6, 56, 66, str),
    "ref_node": (6, 66, 76, int),
    "ref_dir": (6, 76, 80, int),
    "ord_data_type": (7, 0, 10, int),
    "num_pts": (7, 10, 20, int),
    "abscissa_spacing": (7, 20, 30, int),
    "abscissa_min": (7, 30, 43, float),
    "abscissa_inc": (7, 43, 56, float),
    "abscissa_spec_data_type": (8, 0, 10, int),
    "abscissa_axis_units_lab": (8, 47, 67, str),
    "ordinate_spec_data_type": (9, 0, 10, int),
    "ordinate_axis_units_lab": (9, 47, 67, str),
    "orddenom_spec_data_type": (10, 0, 10, int),
    "orddenom_axis_units_lab": (10, 47, 67, str),
}
_IEEE_754 = b"2"  # floating-point format of a binary dataset 58
_SI = 1  # units code of dataset 164
_NOT_METERS = (2, 4, 5, 6, 7, 8, 10)  # such codes: feet, millimeters, centimeters, inches
# Coordinate systems that are global, by dataset: mesh programs give the global one the number 1.
_GLOBAL_SYSTEMS = {15: (0,), 2411: (0, 1)}
_MARK = re.compile(rb"^ {4}-1[ \t]*(?:\r?\n|\r|\Z)", re.MULTILINE)
_BINARY_END = re.compile(rb" {4}-1[ \t]*(?:\r?\n|\r|\Z)")  # no line end before it
_HEADER = re.compile(
    rb"[ \t]*(?P<kind>\d{1,9})(?!\d)"
    rb"(?:[bB]\s*(?P<order>\d)\s*(?P<floats>\d+)\s*\d+[ \t]+(?P<bytes>\d{1,18})(?!\d))?[^\r\n]*"
)
# As Fortran writes them: they may touch, with D for E, or without a letter.
_NUMBER = re.compile(
    rb"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eEdD][-+]?\d+|[-+]\d{2,3}(?![\d.]))?|[-+]?\b(?i:nan|inf\w*)\b"
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
    numbers that are not finite, which pyuff would write as zeros.
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
    """Read a file; raises InputError with file and line if it is damaged or of another format."""
    nodes: dict[int, tuple[float, ...]] = {}
    turned: set[int] = set()
    functions: list[Function] = []
    length = 1.0
    for block in blocks(path, read_measured_bytes(path)):
        if block.kind == 58:
            functions.append(_function(path, block))
        elif block.kind == 164:
            length, _ = units_of(path, block)
        elif block.kind in (15, 2411):
            read_nodes(path, block, nodes, turned)
    for function in functions:
        local = turned.intersection((function.response, function.reference))
        if local:
            raise InputError(
                f"{function.place}: responses must be in the global system, got a local one of "
                f"node {min(local)}; export them in global coordinates"
            )
    return Universal(
        {n: (x / length, y / length, z / length) for n, (x, y, z) in nodes.items()}, functions
    )


def text_of(path: Path, content: bytes) -> str:
    """Return the text of a measured file in UTF-8, or UTF-16 with a mark; raises InputError."""
    try:
        text = content.decode(_encoding(content))
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: text must be UTF-8; save it as such") from error
    if "\0" in text:
        raise InputError(f"{path}: file must be text in UTF-8, got zero bytes; export it as such")
    return text


def text_stream(file: BinaryIO) -> TextIOWrapper:
    """Return the text of an open file in UTF-8, or UTF-16 with a mark, with any line ends."""
    start = file.read(2)
    file.seek(0)
    return TextIOWrapper(file, _encoding(start), newline=None)


def _encoding(start: bytes) -> str:
    return "utf-16" if start.startswith(_UTF_16) else "utf-8-sig"


def read_measured_bytes(path: Path) -> bytes:
    """Read a measured file; raises InputError if it is missing, empty or too large."""
    with open_measured(path) as file:
        content = file.read()
    if not content.strip():
        raise InputError(f"{path}: file is empty; export the measurement again")
    return content


@contextmanager
def open_measured(path: Path) -> Iterator[BinaryIO]:
    """Open a measured file; raises InputError if it is missing or too large."""
    try:
        with open_regular(path, MAX_UFF_BYTES) as file:
            yield file
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error


@dataclass(frozen=True)
class DatasetBlock:
    """One dataset: the line of its opening mark, its number, the content between its marks.

    byte_order: of a binary dataset, in NumPy's notation; empty for text.
    """

    line: int
    kind: int
    byte_order: str
    content: bytes

    @property
    def rows(self) -> list[bytes]:
        """Lines of text, with the number of the dataset first."""
        return self.content.splitlines()


def blocks(path: Path, content: bytes) -> Iterator[DatasetBlock]:
    """Yield the datasets of a file, between lines of `    -1` alone."""
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
    line, counted = 1, 0
    while start is not None:
        line += content.count(b"\n", counted, start.start())
        counted = start.start()
        begin = start.end()
        head = _HEADER.match(content, begin)
        if head is None:
            raise InputError(
                f"{path}:{line}: dataset must begin with its number, got none; export it again"
            )
        if head["floats"] not in (None, _IEEE_754):
            raise InputError(
                f"{path}:{line}: floating-point format must be 2 (IEEE 754), got "
                f"{int(head['floats'])}; export it as IEEE 754 or as ASCII"
            )
        data = begin
        if head["order"]:  # its numbers are any bytes
            for _ in range(_HEADER_LINES):
                data = content.find(b"\n", data) + 1 or len(content)
            data += int(head["bytes"] or 0)
        end = (_BINARY_END if head["order"] else _MARK).search(content, data)
        if end is None:
            raise InputError(
                f"{path}:{line}: dataset has no end; the file was cut off, export it again"
            )
        kind = int(head["kind"])
        yield DatasetBlock(
            line, kind, {b"1": "<", None: ""}.get(head["order"], ">"), content[begin : end.start()]
        )
        start = _MARK.search(content, end.end())


def _as_58(function: Function) -> dict[str, Any]:
    steps = np.diff(function.x)
    even = function.data_types[0] == UFF_TIME and len(steps) > 0 and np.ptp(steps) < 1e-6 * steps[0]
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
        "abscissa_axis_units_lab": "s" if function.data_types[0] == UFF_TIME else "Hz",
        "ordinate_axis_units_lab": function.units[0] or "NONE",
        "orddenom_axis_units_lab": function.units[1] or "NONE",
        "x": function.x,
        "data": function.data,
    }


def _header(place: str, block: DatasetBlock) -> dict[str, Any]:
    """Return the fields of a dataset 58 by name; 0 for missing numbers."""
    head, fields = b"\n".join(block.rows[:_HEADER_LINES]), dict[str, Any]()
    try:
        lines = head.decode().split("\n")
    except UnicodeDecodeError:
        lines = head.decode("latin-1").split("\n")
    try:
        for name, (line, first, last, read) in _FIELDS.items():
            text = lines[line][first:last].strip()
            fields[name] = text if read is str else read(text.upper().replace("D", "E") or "0")
    except (IndexError, ValueError) as error:
        raise InputError(f"{place}: dataset 58 cannot be read; export it again") from error
    for name in ("abscissa_min", "abscissa_inc"):
        if not math.isfinite(fields[name]):
            raise InputError(
                f"{place}: {name} must be a finite number, got {fields[name]:g}; export it again"
            )
    if fields["num_pts"] < 1:
        raise InputError(
            f"{place}: number of values must be at least 1, got {fields['num_pts']}; export it "
            "again"
        )
    return fields


def _function(path: Path, block: DatasetBlock) -> Function:
    place = f"{path}:{block.line}"
    header = _header(place, block)
    count = header["num_pts"]
    is_complex, is_even = header["ord_data_type"] in (5, 6), header["abscissa_spacing"] == 1
    shape = (count, 1 + is_complex + (not is_even))
    read = _bytes_of if block.byte_order else _numbers_of
    values = read(path, block, header, math.prod(shape))
    if len(values) < math.prod(shape):
        raise InputError(
            f"{place}: record must have {math.prod(shape)} numbers according to its header, got "
            f"{len(values)}; the file is damaged, export it again"
        )
    values = values.reshape(shape)
    if not (np.abs(values) <= MAX_VALUE).all():
        raise InputError(
            f"{place}: values of the record must be finite, up to {MAX_VALUE:g}; measure it again"
        )
    x = (
        header["abscissa_min"] + np.arange(count) * header["abscissa_inc"]
        if is_even
        else values[:, 0]
    )
    if count == 0 or not ((np.diff(x) > 0).all() and abs(x[-1]) <= MAX_VALUE):
        raise InputError(f"{place}: abscissa of the record must ascend; export it again")
    data = values[:, -2] + 1j * values[:, -1] if is_complex else values[:, -1]
    names = (_name(header["rsp_ent_name"]), _name(header["ref_ent_name"]))
    return Function(
        place,
        header["func_type"],
        header["rsp_node"],
        header["ref_node"],
        names,
        (header["rsp_dir"], header["ref_dir"]),
        x,
        data,
        tuple(header[f"{axis}_spec_data_type"] for axis in ("abscissa", "ordinate", "orddenom")),
        (_name(header["ordinate_axis_units_lab"]), _name(header["orddenom_axis_units_lab"])),
        _name(header["abscissa_axis_units_lab"]),
        _name(block.rows[_NOTE].decode("utf-8", "replace")),
    )


def _bytes_of(path: Path, block: DatasetBlock, header: Mapping[str, Any], count: int) -> FloatArray:
    """Return up to `count` numbers of a binary record."""
    data = block.content.split(b"\n", _HEADER_LINES)[-1]
    size = 8 if header["ord_data_type"] in (4, 6) else 4
    if data[count * size :].strip(b"\0 \t\r\n"):
        raise InputError(
            f"{path}:{block.line}: record must end after {count} numbers according to its header, "
            f"got {len(data) - count * size} bytes more; export it again, and copy it as a binary "
            "file"
        )
    whole = min(count, len(data) // size) * size
    return np.frombuffer(data[:whole], dtype=f"{block.byte_order}f{size}").astype(float)


def _numbers_of(
    path: Path, block: DatasetBlock, header: Mapping[str, Any], count: int
) -> FloatArray:
    """Return up to `count` numbers of a record in ASCII, without the filling of the last line."""
    numbers: list[float] = []
    for line, row in enumerate(block.rows[_HEADER_LINES:], start=block.line + 1 + _HEADER_LINES):
        if _NUMBER.sub(b"", row).strip() or (len(numbers) >= count and row.strip()):
            raise InputError(
                f"{path}:{line}: data must be numbers, {count} in all, got {_quoted(row)}; export "
                "the damaged file again"
            )
        numbers += numbers_in(row, f"{path}:{line}")
    return np.array(numbers[:count])


def numbers_in(row: bytes, place: str) -> list[float]:
    """Return all numbers of a row, in any spelling of Fortran.

    place: file and line, for the error. Raises InputError for other text, and for NaN and infinite
    numbers.
    """
    if _NUMBER.sub(b"", row).strip():
        raise InputError(f"{place}: line must be of numbers, got {_quoted(row)}; export it again")
    words = (word.upper().replace(b"D", b"E") for word in _NUMBER.findall(row))
    numbers = [float(_NO_LETTER.sub(b"E", word)) for word in words]
    for number in numbers:
        if not math.isfinite(number):
            raise InputError(f"{place}: numbers must be finite, got {number:g}; export them again")
    return numbers


def _quoted(row: bytes) -> str:
    return repr(row.decode("ascii", "backslashreplace").strip()[:40])


def units_of(path: Path, block: DatasetBlock) -> tuple[float, float]:
    """Return the divisors from lengths and forces of a file to meters and newtons."""
    place = f"{path}:{block.line}"
    rows = block.rows[1:]
    code = numbers_in(rows[0][:10], f"{path}:{block.line + 2}") if rows else []
    factors: list[float] = []
    for line, row in enumerate(rows[1:], start=block.line + 3):
        factors += numbers_in(row, f"{path}:{line}")
    if not code or len(factors) < 2:
        raise InputError(f"{place}: units (dataset 164) must have a code and factors; export again")
    label = rows[0][10:30].decode("ascii", "replace").strip()
    length, force = factors[:2]
    if not 0 < length < math.inf or (length == 1 and int(code[0]) in _NOT_METERS):
        raise InputError(
            f"{place}: length factor (dataset 164) must be positive and match units code "
            f"{int(code[0])} {label!r}, got {length:g}; export it in SI"
        )
    if not 0 < force < math.inf:
        raise InputError(f"{place}: force factor must be positive, got {force:g}")
    return length, force


def rows_of(
    path: Path, block: DatasetBlock, size: int, head: int = 1
) -> Iterator[list[list[float]]]:
    """Yield the numbers of records, each of `size` rows, after a head."""
    rows = block.rows[head:]
    if len(rows) % size:
        raise InputError(
            f"{path}:{block.line + head + len(rows)}: dataset {block.kind} must have {size} rows "
            f"for each entry, got {len(rows)} in all; the file is damaged, export it again"
        )
    record: list[list[float]] = []
    for line, row in enumerate(rows, start=block.line + 1 + head):
        record.append(numbers_in(row, f"{path}:{line}"))
        if len(record) == size:
            yield record
            record = []


def read_nodes(
    path: Path,
    block: DatasetBlock,
    nodes: dict[int, tuple[float, ...]],
    turned: set[int],
) -> None:
    """Add the nodes of a dataset, and the numbers of nodes with local displacements."""
    size = 1 if block.kind == 15 else 2
    for count, record in enumerate(rows_of(path, block, size)):
        numbers = [number for row in record for number in row]
        if len(numbers) != 7:
            raise InputError(
                f"{path}:{block.line + 2 + size * count}: node must have a number, three codes and "
                f"three coordinates, got {len(numbers)} numbers; export it again"
            )
        nodes[int(numbers[0])] = tuple(numbers[4:])
        displacement_system = int(numbers[2])
        if displacement_system not in _GLOBAL_SYSTEMS[block.kind]:
            turned.add(int(numbers[0]))


def _name(text: str) -> str:
    return "" if text.strip().upper() == "NONE" else text.strip()
