"""Convert the modes of a CalculiX model for the key `surface` of a rig: write MODEL.npz.

    python examples/calculix/from_calculix.py MODEL [--set TOUCH] [--unroll]

MODEL.inp contains the touched nodes as a node set (*NSET). MODEL.frd contains the results of a
*FREQUENCY step with *NODE FILE and U, in ASCII. Both are in m, kg and s. The outline is taken from
the element faces with all corners in the set. With --unroll, positions are measured along the arc
of a surface that is bent about y, as a touch panel reports them.
"""

import argparse
import re
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

_HEXAHEDRON = [(0, 1, 2, 3), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7)]
_WEDGE = [(0, 1, 2), (3, 4, 5), (0, 1, 4, 3), (1, 2, 5, 4), (2, 0, 3, 5)]
_TETRAHEDRON = [(0, 1, 2), (0, 1, 3), (1, 2, 3), (2, 0, 3)]
FACES = {
    1: _HEXAHEDRON,
    4: _HEXAHEDRON,
    2: _WEDGE,
    5: _WEDGE,
    3: _TETRAHEDRON,
    6: _TETRAHEDRON,
    7: [(0, 1, 2)],
    8: [(0, 1, 2)],
    9: [(0, 1, 2, 3)],
    10: [(0, 1, 2, 3)],
}
"""Corners of every element face, for each element type in a .frd file."""

# A value has 12 characters (E12.5). With a three-digit exponent, as on Windows, it has up to 13 and
# touches the next value; Fortran also omits the letter of such an exponent. The single digit before
# the decimal point shows where the next number begins.
_NUMBER = r"\s*([-+]?(?:\d\.\d+(?:[ED][-+]?\d{2,3}|[-+]\d{3})|\d+\.\d*))"
_NO_LETTER = re.compile(r"(?<=\d)(?=[-+])")
_NODE_NUMBER = {0: 5, 1: 10}
"""Width of a node number in characters, by block format (short or long ASCII)."""

_MODAL = 2  # analysis type of a result block
_MAX_INCLUDES = 10


@dataclass(frozen=True)
class Mode:
    """A mode in a .frd file."""

    frequency: float
    """Natural frequency [Hz]."""

    shape: dict[int, list[float]] = field(default_factory=dict)
    """Displacement by node number."""


@dataclass(frozen=True)
class Results:
    """Mesh and modes in a .frd file."""

    nodes: dict[int, list[float]]
    """Positions by node number."""

    elements: list[tuple[int, list[int]]]
    """Type and nodes of each element."""

    modes: list[Mode]


def read_set(path: Path, name: str) -> list[int]:
    """Return the node numbers of a set; raises ValueError with file and line."""
    sets: dict[str, dict[int, None]] = {}
    instances: dict[str, set[str]] = {}
    target: dict[int, None] | None = None
    parameters: dict[str, str] = {}
    keyword = ""
    for place, line in _input_lines(path):
        if line.startswith("*"):
            keyword, parameters = _keyword(line)
            own_name = parameters.get("NSET", "") if keyword in ("NSET", "NODE") else ""
            target = sets.setdefault(own_name, {}) if own_name else None
            if keyword == "NSET" and "INSTANCE" in parameters:
                instances.setdefault(own_name, set()).add(parameters["INSTANCE"])
        elif target is not None:
            entries = [entry.strip().upper() for entry in line.split(",") if entry.strip()]
            if keyword == "NODE":
                entries = entries[:1]
            target.update(dict.fromkeys(_numbers_of(entries, parameters, sets, place)))
    requested = name.upper()
    instance_names = sorted(instances.get(requested, ()))
    if len(instance_names) > 1:
        raise ValueError(
            f"{path}: node set {name} must belong to one instance, got "
            f"{', '.join(instance_names)}; CalculiX ignores instance=, so export the model without "
            "instances to make node numbers unique"
        )
    if not sets.get(requested):
        set_names = ", ".join(sorted(sets)) or "no sets"
        raise ValueError(
            f"{path}: must have the node set {name}, got {set_names}; add a line "
            f"*NSET, NSET={name}, or name another set with --set"
        )
    return list(sets[requested])


def _input_lines(path: Path, depth: int = 0) -> Iterator[tuple[str, str]]:
    """Yield location (file:line) and text of each line; *INCLUDE inserts a file."""
    text = path.read_text(encoding="utf-8", errors="replace")
    for number, line in enumerate(text.splitlines(), start=1):
        stripped = line.strip()
        if not stripped or stripped.startswith("**"):
            continue
        if _keyword(stripped)[0] == "INCLUDE":
            file = stripped.partition("=")[2].strip().strip('"')
            if depth == _MAX_INCLUDES:
                raise ValueError(f"{path}:{number}: *INCLUDE must not be nested this deeply")
            yield from _input_lines(path.parent / file, depth + 1)
        else:
            yield f"{path}:{number}", stripped


def _keyword(line: str) -> tuple[str, dict[str, str]]:
    """Return keyword and parameters of a line in upper case, without the asterisk."""
    keyword, *rest = (word.strip() for word in line.upper().lstrip("*").split(","))
    parameters = {}
    for word in rest:
        key, _, value = word.partition("=")
        parameters[key.strip()] = value.strip().strip('"')
    return keyword.replace(" ", ""), parameters


def _numbers_of(
    entries: list[str], parameters: dict[str, str], sets: dict[str, dict[int, None]], place: str
) -> list[int]:
    """Return the node numbers of a data line: numbers, set names or a range (GENERATE)."""
    if "GENERATE" in parameters:
        try:
            first, last, *step = (int(entry) for entry in entries)
            return list(range(first, last + 1, step[0] if step else 1))
        except ValueError:
            raise ValueError(
                f"{place}: GENERATE line must have a first number, a last number and optionally a "
                f"step, got {', '.join(entries)}"
            ) from None
    numbers: list[int] = []
    for entry in entries:
        if entry in sets:
            numbers.extend(sets[entry])
            continue
        try:
            numbers.append(int(entry))
        except ValueError:
            raise ValueError(
                f"{place}: node set must have whole numbers or names of earlier sets, got {entry}"
            ) from None
    return numbers


@dataclass(frozen=True)
class _Block:
    """A block of a .frd file: nodes (2C), elements (3C) or results (100C)."""

    kind: str
    place: str
    """Location of the header, file:line."""

    header: str
    step: int
    """Number of the analysis step."""

    rows: list[tuple[str, str]] = field(default_factory=list)
    """Lines after the header: location and text."""

    @property
    def width(self) -> int:
        """Width of a node number in characters; raises ValueError for binary blocks."""
        code = _whole(self.header[73:75], self.place)
        if code not in _NODE_NUMBER:
            raise ValueError(f"{self.place}: .frd file must be ASCII, got binary data")
        return _NODE_NUMBER[code]


def read_frd(path: Path) -> Results:
    """Return mesh and modes; raises ValueError with file and line."""
    results = Results({}, [], [])
    steps: set[int] = set()
    for block in _blocks(path):
        if block.kind == "2C":
            results.nodes.update(_values(block))
        elif block.kind == "3C":
            results.elements.extend(_elements(block))
        elif _is_mode(block):
            steps.add(block.step)
            (frequency,) = _numbers(block.header[12:24], 1, block.place)
            results.modes.append(Mode(frequency, _values(block)))
    if not results.modes:
        raise ValueError(
            f"{path}: must contain modes, got none; use *FREQUENCY, and *NODE FILE with U, in one "
            "step"
        )
    if len(steps) > 1:
        raise ValueError(
            f"{path}: modes must come from one *FREQUENCY step, got steps "
            f"{', '.join(map(str, sorted(steps)))}; remove *NODE FILE from the other steps"
        )
    return results


def _blocks(path: Path) -> Iterator[_Block]:
    """Yield the blocks with nodes, elements and results."""
    block: _Block | None = None
    step = 0
    lines = path.read_text(encoding="ascii", errors="replace").splitlines()
    for number, line in enumerate(lines, start=1):
        place = f"{path}:{number}"
        kind = line[:6].strip()
        if line.startswith("    1PSTEP"):
            step = _whole(line.split()[-1], place)
        elif kind in ("2C", "3C", "100C"):
            block = _Block(kind, place, line, step)
        elif line.startswith(" -3") and block is not None:
            yield block
            block = None
        elif block is not None:
            block.rows.append((place, line))
    if block is not None:
        raise ValueError(f"{block.place}: block must end with -3, got the end of the file")


def _is_mode(block: _Block) -> bool:
    """Whether a block is the displacements of a mode; raises ValueError for complex modes."""
    names = [line.split()[1:2] for _, line in block.rows if line.startswith(" -4")]
    if names == [["DISPI"]]:
        raise ValueError(
            f"{block.place}: modes must be real, got complex or cyclic modes; use *FREQUENCY alone"
        )
    return names == [["DISP"]] and _whole(block.header[56:58], block.place) == _MODAL


def _values(block: _Block) -> dict[int, list[float]]:
    """Return the three values of each node in a block."""
    end = 3 + block.width
    return {
        _whole(line[3:end], place): _numbers(line[end:], 3, place)
        for place, line in block.rows
        if line.startswith(" -1")
    }


def _elements(block: _Block) -> list[tuple[int, list[int]]]:
    """Return type and nodes of each element in a block."""
    width = block.width
    elements: list[tuple[int, list[int]]] = []
    for place, line in block.rows:
        if line.startswith(" -1"):
            elements.append((_whole(line[3 + width : 8 + width], place), []))
        elif line.startswith(" -2") and elements:
            text = line[3:].rstrip()
            cuts = range(0, len(text), width)
            elements[-1][1].extend(_whole(text[cut : cut + width], place) for cut in cuts)
    return elements


def _whole(text: str, place: str) -> int:
    """Return a whole number; raises ValueError for other text."""
    try:
        return int(text)
    except ValueError:
        raise ValueError(
            f"{place}: line must have a whole number, got {text.strip()!r}; run CalculiX again"
        ) from None


def _numbers(text: str, count: int, place: str) -> list[float]:
    """Return a line's numbers, exactly `count` of them; raises ValueError for other text."""
    if "," in text:
        raise ValueError(
            f"{place}: numbers must have decimal points, got commas in {text.strip()!r}; run "
            "CalculiX with the locale C"
        )
    match = re.fullmatch(_NUMBER * count + r"\s*", text)
    if match is None:
        raise ValueError(
            f"{place}: line must have {count} numbers such as -1.23456E-01, got {text.strip()!r}; "
            "run CalculiX again"
        )
    numbers = []
    for word in match.groups():
        with_letter = word.replace("D", "E")
        if "E" not in with_letter:
            with_letter = _NO_LETTER.sub("E", word)
        numbers.append(float(with_letter))
    return numbers


def unrolled(nodes: np.ndarray) -> np.ndarray:
    """Return positions (n, 2) [m] of nodes (n, 3): along the arc z(x), and along y."""
    x, first = np.unique(nodes[:, 0].round(7), return_index=True)
    lengths = np.hypot(np.diff(x), np.diff(nodes[first, 2]))
    arc = np.concatenate([[0.0], np.cumsum(lengths)])
    return np.column_stack([np.interp(nodes[:, 0], x, arc), nodes[:, 1]])


def convert(model: Path, name: str = "TOUCH", *, unroll: bool = False) -> Path:
    """Write MODEL.npz and return its path; raises ValueError and OSError."""
    results_file = model.with_suffix(".frd")
    touch = read_set(model.with_suffix(".inp"), name)
    results = read_frd(results_file)
    _check_nodes(f"{results_file}: mesh", results.nodes, touch, name)
    for mode in results.modes:
        _check_nodes(f"{results_file}: mode", mode.shape, touch, name)
    faces = _touched_faces(results.elements, touch)
    nodes = np.array([results.nodes[number] for number in touch])
    arrays = {
        "nodes": nodes,
        "frequencies": np.array([mode.frequency for mode in results.modes]),
        "shapes": np.array([[mode.shape[number] for number in touch] for mode in results.modes]),
    }
    if faces:
        # A triangle among quadrilaterals repeats its last corner.
        corner_count = max(map(len, faces))
        padded = [[*face, *face[-1:] * (corner_count - len(face))] for face in faces]
        arrays["faces"] = np.array(padded, dtype=int)
    if unroll:
        arrays["places"] = unrolled(nodes)
    np.savez(model.with_suffix(".npz"), **arrays)
    return model.with_suffix(".npz")


def _check_nodes(what: str, values: Mapping[int, object], touch: list[int], name: str) -> None:
    """Raise ValueError unless there is a value for each touched node."""
    missing = [number for number in touch if number not in values]
    if missing:
        raise ValueError(
            f"{what} must have all {len(touch)} nodes of {name}, got "
            f"{len(touch) - len(missing)} without node {missing[0]}; for shells use *NODE FILE, "
            "OUTPUT=2D"
        )


def _touched_faces(elements: list[tuple[int, list[int]]], touch: list[int]) -> list[list[int]]:
    """Return the element faces with all corners touched, as rows of the touched nodes."""
    rows = {number: row for row, number in enumerate(touch)}
    faces = []
    for kind, nodes in elements:
        for face in FACES.get(kind, []):
            corners = [nodes[corner] for corner in face]
            if all(corner in rows for corner in corners):
                faces.append([rows[corner] for corner in corners])
    return faces


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("model", type=Path)
    parser.add_argument("--set", default="TOUCH")
    parser.add_argument("--unroll", action="store_true")
    options = parser.parse_args()
    try:
        modes_file = convert(options.model, options.set, unroll=options.unroll)
    except OSError as error:
        sys.exit(f"from_calculix: {error.filename or options.model}: {error.strerror}")
    except ValueError as error:
        sys.exit(f"from_calculix: {error}")
    print("wrote", modes_file)


if __name__ == "__main__":
    main()
