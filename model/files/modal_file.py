"""Modes of a surface from another program: universal files (UFF), NumPy files (.npz) and CSV.

In a universal file, nodes (datasets 15 and 2411), shell elements (2412), modes (55 and 2414) and
units (164) are read by position, according to the definitions of the format (Structural Dynamics
Research Laboratory, University of Cincinnati); other datasets are ignored. Values can be in any
spelling of Fortran. A .npz has the arrays nodes (n, 3) [m], frequencies (r,) [Hz] and shapes
(r, n, 3), or (r, n) along the normal, [1/sqrt(kg)], and optionally damping_ratios (r,), places
(n, 2) [m], the nodes in touch coordinates, and faces (k, 3 or more), rows of node numbers from 0. A
.csv has a line for each node of each mode, with the columns of `_COLUMNS` and damping_ratio.
"""

import cmath
import math
from array import array
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from io import BytesIO
from itertools import islice
from pathlib import Path

import numpy as np

from model.arrays import ComplexArray, FloatArray
from model.errors import MAX_VALUE, InputError
from model.files.array_file import REAL_NUMBERS, UNREADABLE, WHOLE_NUMBERS, arrays_in
from model.files.csv_file import read_lines
from model.files.uff import DatasetBlock, blocks, numbers_in, read_nodes, rows_of, units_of

_SHELLS = frozenset(range(40, 100)) | {171, 172}  # plane stress, plates, membranes, thin shells
_BEAMS = frozenset(range(11, 38))  # whose elements have a further row
# Analysis types. First-order complex modes have a modal A, second-order ones a mass.
_NORMAL_MODES, _FIRST_ORDER, _SECOND_ORDER = 2, 3, 7
_MODES = (_NORMAL_MODES, _FIRST_ORDER, _SECOND_ORDER)
_DISPLACEMENT = (0, 8)  # unknown, displacement
_MAX_COMPLEX = 0.3  # imaginary part that a turned shape may have, relative to its real part
_MAX_ROUNDING = 1.0  # Hz; below 0, of the frequencies of rigid-body modes
_VALUES_A_ROW = 6
_MAX_REALS = 14  # numbers of a mode before its shape; missing ones are 0
_HEAD = {55: (9, 6), 2414: (14, 9)}
"""Rows before the first node of a mode, and the row with its types, by dataset."""

_OPTIONAL = {"damping_ratios", "places", "faces"}
_ARRAYS = {
    **dict.fromkeys(("nodes", "frequencies", "shapes", "damping_ratios", "places"), REAL_NUMBERS),
    "faces": WHOLE_NUMBERS,
}
_COLUMNS = ("mode", "frequency_hz", "x_m", "y_m", "z_m", "shape_x", "shape_y", "shape_z")
_BINARY_ZIP = b"PK\x03\x04"


@dataclass(frozen=True, eq=False)
class ModeShapes:
    """Modes of a file, in SI units and with unit modal mass."""

    nodes: FloatArray
    """Positions (n, 3) [m]."""

    frequencies: FloatArray
    """Natural frequencies (r,) [Hz]."""

    shapes: FloatArray
    """Displacements (r, n, 3), or (r, n) along the normal, [1/sqrt(kg)]."""

    damping_ratios: FloatArray
    """(r,), NaN if missing in the file."""

    faces: Sequence[Sequence[int]] = ()
    """Nodes of each face in order, by row."""

    places: FloatArray | None = None
    """Nodes in touch coordinates (n, 2) [m]; None if they are projected."""


def read_modes(path: Path, content: bytes) -> ModeShapes:
    """Read the modes of a file with this content; raises InputError with file and line."""
    ending = path.suffix.lower()
    if ending == ".npz" or content.startswith(_BINARY_ZIP):
        modes = _from_arrays(path, content)
    elif ending == ".csv":
        modes = _from_lines(path)
    else:
        modes = _from_universal(path, content)
    for name in ("nodes", "frequencies", "shapes"):
        if not (np.abs(getattr(modes, name)) <= MAX_VALUE).all():
            raise InputError(
                f"{path}: {name} of modes must be finite numbers up to {MAX_VALUE:g}; export them "
                "again"
            )
    lowest = float(modes.frequencies.min(initial=0.0))
    if lowest < -_MAX_ROUNDING:
        raise InputError(
            f"{path}: frequencies of modes must be 0 Hz or above, got {lowest:g} Hz; export them "
            "again"
        )
    return modes


def _from_arrays(path: Path, content: bytes) -> ModeShapes:
    try:
        arrays = arrays_in(BytesIO(content), _ARRAYS, optional=_OPTIONAL)
    except UNREADABLE as error:
        raise InputError(
            f"{path}: .npz of modes must be readable, got: {error}; write it again with numpy.savez"
        ) from error
    nodes, frequencies, shapes = arrays["nodes"], arrays["frequencies"], arrays["shapes"]
    n = nodes.shape[:1] or (0,)
    r = frequencies.shape[:1] or (0,)
    expected = {"nodes": [(*n, 3)], "frequencies": [r], "shapes": [(*r, *n, 3), (*r, *n)]}
    expected |= {"damping_ratios": [r], "places": [(*n, 2)]}
    for name, accepted in expected.items():
        if name in arrays and arrays[name].shape not in accepted:
            raise InputError(
                f"{path}: {name} must be of shape {' or '.join(map(str, accepted))}, got "
                f"{arrays[name].shape}; write it again"
            )
    for name in ("places", "damping_ratios"):
        if not np.isfinite(arrays.get(name, 0.0)).all():
            raise InputError(f"{path}: {name} of modes must be finite; leave out the array")
    faces = arrays.get("faces", np.empty((0, 3), dtype=int))
    is_table = faces.ndim == 2 and faces.shape[1] >= 3
    if not is_table or ((faces < 0) | (faces >= n[0])).any():
        raise InputError(
            f"{path}: faces must be rows of 3 or more node numbers from 0 to {n[0] - 1}; write "
            "them again"
        )
    places = arrays.get("places")
    return ModeShapes(
        nodes.astype(float),
        frequencies.astype(float),
        shapes.astype(float),
        arrays.get("damping_ratios", np.full(r, math.nan)).astype(float),
        faces.tolist(),
        None if places is None else places.astype(float),
    )


def _from_lines(path: Path) -> ModeShapes:
    """Read a CSV file: one mode after another, each at the same nodes in the same order."""
    numbers = array("d")  # in place of Python's own, which take four times the memory
    for line in read_lines(path, _COLUMNS, optional=["damping_ratio"]):
        numbers.extend(line.number(column) for column in _COLUMNS)
        numbers.append(line.number("damping_ratio", math.nan))
    values = np.frombuffer(numbers).reshape(-1, len(_COLUMNS) + 1)
    count = int((values[:, 0] == values[0, 0]).sum())
    rows = np.arange(len(values))
    first = np.hstack([values[rows - rows % count, :2], values[rows % count, 2:5]])
    is_other = (values[:, :5] != first).any(axis=1)
    if len(values) % count:
        is_other[-1] = True
    if is_other.any():
        number = int(is_other.argmax())
        lines = islice(read_lines(path, _COLUMNS, optional=["damping_ratio"]), number, None)
        raise InputError(
            f"{next(lines).place}: modes must follow each other, each with one number and "
            f"frequency and the {count} nodes of the first one in its order, got another line; "
            "export them again"
        )
    return ModeShapes(
        values[:count, 2:5],
        values[::count, 1],
        values[:, 5:8].reshape(-1, count, 3),
        values[::count, 8],
    )


def _from_universal(path: Path, content: bytes) -> ModeShapes:
    length = force = 1.0
    nodes: dict[int, tuple[float, ...]] = {}
    turned: set[int] = set()
    modes: list[_Mode] = []
    faces: list[list[int]] = []
    kinds = set()
    for block in blocks(path, content):
        kinds.add(block.kind)
        if block.kind == 164:
            length, force = units_of(path, block)
        elif block.kind in (15, 2411):
            read_nodes(path, block, nodes, turned)
        elif block.kind == 2412:
            faces += _read_faces(path, block)
        elif block.kind in _HEAD and (mode := _read_mode(path, block)) is not None:
            modes.append(mode)
    if not nodes:
        raise InputError(
            f"{path}: must have nodes (dataset 15 or 2411), got datasets {sorted(kinds)}; export "
            "them with the modes"
        )
    if not modes:
        raise InputError(
            f"{path}: must have normal modes (dataset 55 or 2414), got datasets {sorted(kinds)}; "
            "export shapes of modes, not records"
        )
    # A pole and its conjugate are one mode.
    modes = [mode for mode in modes if not mode.is_conjugate] or modes
    numbers = modes[0].nodes
    for mode in modes:
        if mode.nodes != numbers:
            raise InputError(
                f"{mode.place}: all modes must have the nodes of the first mode ({len(numbers)}), "
                f"got {len(mode.nodes)} nodes, {len(set(mode.nodes) & set(numbers))} of them in "
                "common; export one component"
            )
    missing = [number for number in numbers if number not in nodes]
    if missing:
        raise InputError(
            f"{modes[0].place}: node {missing[0]} of the modes must have coordinates (dataset 15 "
            f"or 2411), got none of {len(missing)} nodes; export all nodes"
        )
    local = turned & set(numbers)
    if local:
        raise InputError(
            f"{path}: displacements must be in the global system, got a local one of node "
            f"{min(local)}; export shapes in global coordinates"
        )
    rows = {number: row for row, number in enumerate(numbers)}
    # Modal masses are in the file's unit of mass, force s² / length.
    return ModeShapes(
        np.array([nodes[number] for number in numbers]) / length,
        np.array([mode.frequency for mode in modes]),
        np.array([mode.shape for mode in modes]) * math.sqrt(force / length),
        np.array([mode.damping_ratio for mode in modes]),
        [[rows[number] for number in face] for face in faces if rows.keys() >= set(face)],
    )


@dataclass(frozen=True)
class _Mode:
    """One mode of a universal file, its shape (n, 3) or (n,) of unit modal mass."""

    place: str
    frequency: float
    damping_ratio: float
    nodes: list[int]
    shape: FloatArray
    is_conjugate: bool
    """Whether the imaginary part of its pole is negative."""


def _read_faces(path: Path, block: DatasetBlock) -> Iterator[list[int]]:
    """Yield the nodes of each shell element."""
    lines = enumerate(block.rows[1:], start=block.line + 2)
    rows, at = [numbers_in(row, f"{path}:{line}") for line, row in lines], 0
    while at < len(rows):
        if len(rows[at]) < 6:
            raise InputError(
                f"{path}:{block.line + 2 + at}: element must have six numbers, got "
                f"{len(rows[at])}; export it again"
            )
        kind, count = int(rows[at][1]), int(rows[at][5])
        at += 1 + (kind in _BEAMS)
        numbers: list[float] = []
        while at < len(rows) and len(numbers) < count:
            numbers += rows[at]
            at += 1
        if kind in _SHELLS:
            yield [int(number) for number in numbers]


def _read_mode(path: Path, block: DatasetBlock) -> _Mode | None:
    """Read a dataset 55 or 2414; None if it is not a mode."""
    place, rows = f"{path}:{block.line}", block.rows
    head, types = _HEAD[block.kind]
    if len(rows) <= head + 1:
        raise InputError(f"{place}: dataset {block.kind} must have a mode, got {len(rows)} rows")

    def numbers(row: int) -> list[float]:
        return numbers_in(rows[row], f"{path}:{block.line + 1 + row}")

    # The row of types is the sixth of a dataset 55 and the ninth of a dataset 2414.
    kinds = [int(number) for number in numbers(types)]
    if block.kind == 2414:
        location = numbers(3)
        if location and int(location[0]) != 1:
            return None  # at elements
    if len(kinds) < 6 or kinds[1] not in _MODES:
        return None
    _, analysis, _, result, data, count = kinds[:6]
    if result not in _DISPLACEMENT:
        raise InputError(
            f"{place}: shapes of modes must be displacements (8), got type {result}; export these"
        )
    if count not in (1, 3, 6):
        raise InputError(
            f"{place}: a mode must have 1, 3 or 6 values at each node, got {count}; export "
            "displacements"
        )
    reals = [number for row in range(types + 2, head) for number in numbers(row)]
    reals += [0.0] * _MAX_REALS
    if analysis == _NORMAL_MODES:
        modal = _normal_mode(place, block.kind, reals)
    else:
        modal = _complex_mode(place, block.kind, analysis, reals)
    is_complex = data in (5, 6)
    nodes, values = _values(path, block, head, count * (1 + is_complex))
    shape: FloatArray | ComplexArray = values
    if is_complex:
        shape = values[:, ::2] + 1j * values[:, 1::2]
    shape = shape[:, 0] if count == 1 else shape[:, :3]
    if is_complex or analysis != _NORMAL_MODES:
        shape = _real(place, np.asarray(shape / cmath.sqrt(modal.mass), dtype=complex))
    else:
        shape = shape / math.sqrt(modal.mass.real)
    return _Mode(
        place, modal.frequency, modal.damping_ratio, nodes, np.asarray(shape), modal.is_conjugate
    )


@dataclass(frozen=True)
class _Modal:
    """Modal parameters of a dataset."""

    frequency: float
    """Natural frequency [Hz]."""

    mass: complex
    """Modal mass; a shape has unit modal mass after division by the square root."""

    damping_ratio: float
    """Share of critical damping, NaN without one."""

    is_conjugate: bool = False
    """Whether the imaginary part of the pole is negative."""


def _normal_mode(place: str, kind: int, reals: Sequence[float]) -> _Modal:
    """Return the parameters of a normal mode; its mass is 1 if missing in the file."""
    if kind == 55:
        frequency, mass, viscous, hysteretic = reals[:4]
    else:
        # Two counts; time, frequency, eigenvalue, mass and damping.
        frequency, _, mass, viscous, hysteretic = reals[3:8]
    if frequency < 0 or mass < 0:
        raise InputError(
            f"{place}: frequency and modal mass must be at least 0, got {frequency:g} Hz and "
            f"{mass:g}; export it again"
        )
    return _Modal(frequency, mass or 1.0, viscous or hysteretic / 2 or math.nan)


def _complex_mode(place: str, kind: int, analysis: int, reals: Sequence[float]) -> _Modal:
    """Return the parameters of a complex mode from its pole and its modal A, or its modal mass.

    For a shape psi at a pole, A is psi' (2 pole M + C) psi. With proportional damping this is 2j
    Im(pole) times the modal mass. The units of A are mass per time.
    """
    if kind == 55 and analysis == _SECOND_ORDER:
        raise InputError(
            f"{place}: analysis type of a mode must be 2 or 3, got 7 (dataset 55 defines no "
            "scale for it); export normal modes (2), or complex ones with their modal A (3)"
        )
    # Behind two counts dataset 2414 has a row for normal modes, then one for complex ones.
    pole_real, pole_imaginary, *scale = reals[:4] if kind == 55 else reals[8:12]
    pole = complex(pole_real, pole_imaginary)
    stated = complex(*scale)
    name = "modal mass" if analysis == _SECOND_ORDER else "modal A"
    if not stated or not pole.imag:
        raise InputError(
            f"{place}: {name} and the imaginary part of the pole must not be 0 in a complex mode, "
            f"got {stated:g} and {pole.imag:g}, which leaves its scale unknown; export normal "
            "modes of unit modal mass"
        )
    mass = stated if analysis == _SECOND_ORDER else stated / (2j * pole.imag)
    return _Modal(
        abs(pole) / (2 * math.pi),
        mass,
        -pole.real / abs(pole) or math.nan,
        is_conjugate=pole.imag < 0,
    )


def _values(path: Path, block: DatasetBlock, head: int, count: int) -> tuple[list[int], FloatArray]:
    """Return the numbers of the nodes (n,), and the values at each node (n, count)."""
    size = 1 + math.ceil(count / _VALUES_A_ROW)
    numbers, values = [], []
    for entry, (number, *rows) in enumerate(rows_of(path, block, size, head)):
        node_values = [value for row in rows for value in row]
        if len(number) != 1 or len(node_values) != count:
            raise InputError(
                f"{path}:{block.line + 1 + head + size * entry}: a node must have its number and "
                f"then {count} values, got {len(node_values)}; the file is damaged, export it again"
            )
        numbers.append(int(number[0]))
        values.append(node_values)
    return numbers, np.array(values)


def _real(place: str, shape: ComplexArray) -> FloatArray:
    """Rotate a complex shape to the phase with the smallest imaginary part."""
    turned = shape * np.exp(-0.5j * np.angle((shape**2).sum()))
    if np.abs(turned.imag).max() > _MAX_COMPLEX * np.abs(turned.real).max():
        raise InputError(
            f"{place}: a mode must be nearly real, got a complex one, whose nodes move at other "
            "times; export normal modes"
        )
    return np.asarray(turned.real)
