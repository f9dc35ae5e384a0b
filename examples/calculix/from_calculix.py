"""Writes modes that CalculiX computed as a file for `surface`, MODEL.npz.

    python examples/calculix/from_calculix.py MODEL [--set TOUCH] [--unroll]

MODEL.inp has the nodes that fingers touch as a set (*NSET), MODEL.frd the results of *FREQUENCY
with *NODE FILE and U in ASCII, both in m, kg and s. Of elements whose faces have all of their
corners in the set the outline is taken. With --unroll places count along the arc of a surface that
is bent about y, as those of a touch panel.
"""

import argparse
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
"""Corners of each face of an element by its type in a .frd."""


def read_set(path: Path, name: str) -> list[int]:
    """Return the nodes of a set of an input file; raises ValueError without it."""
    nodes: list[int] = []
    is_own = False
    for line in path.read_text(encoding="utf-8").upper().splitlines():
        if line.startswith("*"):
            is_own = line.replace(" ", "") == f"*NSET,NSET={name.upper()}"
        elif is_own:
            nodes += [int(each) for each in line.split(",") if each.strip()]
    if not nodes:
        raise ValueError(f"{path}: no node set {name}, written as *NSET, NSET={name}")
    return nodes


def read_frd(
    path: Path,
) -> tuple[dict[int, list[float]], list[tuple[int, list[int]]], list[tuple[float, dict]]]:
    """Return nodes by number, elements with their types, and modes: frequency [Hz] and shape."""
    nodes: dict[int, list[float]] = {}
    elements: list[tuple[int, list[int]]] = []
    modes: list[tuple[float, dict[int, list[float]]]] = []
    frequency, values = 0.0, None
    for line in path.read_text(encoding="ascii", errors="replace").splitlines():
        block, row = line[:6].strip(), line[:3].strip()
        if block == "2C":
            values = nodes
        elif block == "100C":
            frequency = float(line[12:24])
        elif row == "-4":
            values = {}
            if line.split()[1] == "DISP":
                modes.append((frequency, values))
        elif row == "-3":
            values = None
        elif row == "-1" and values is not None:
            values[int(line[3:13])] = [float(line[13 + 12 * n : 25 + 12 * n]) for n in range(3)]
        elif row == "-1":
            elements.append((int(line.split()[2]), []))
        elif row == "-2":
            elements[-1][1].extend(int(each) for each in line[3:].split())
    return nodes, elements, modes


def unrolled(nodes: np.ndarray) -> np.ndarray:
    """Return places (n, 2) [m] of nodes (n, 3) along the arc of their profile z(x), and along y."""
    x, first = np.unique(nodes[:, 0].round(7), return_index=True)
    along = np.hypot(np.diff(x), np.diff(nodes[first, 2]))
    arc = np.concatenate([[0.0], np.cumsum(along)])
    return np.column_stack([np.interp(nodes[:, 0], x, arc), nodes[:, 1]])


def convert(model: Path, name: str = "TOUCH", *, unroll: bool = False) -> Path:
    """Write MODEL.npz; return its path."""
    touch = read_set(model.with_suffix(".inp"), name)
    positions, elements, modes = read_frd(model.with_suffix(".frd"))
    row = {number: at for at, number in enumerate(touch)}
    faces = [
        [row[nodes[corner]] for corner in face]
        for kind, nodes in elements
        for face in FACES.get(kind, [])
        if all(nodes[corner] in row for corner in face)
    ]
    corners = max(map(len, faces), default=3)
    nodes = np.array([positions[each] for each in touch])
    arrays = {
        "nodes": nodes,
        "frequencies": np.array([frequency for frequency, _ in modes]),
        "shapes": np.array([[shape[each] for each in touch] for _, shape in modes]),
        # A triangle among quadrilaterals has its last corner twice.
        "faces": np.array([[*f, *f[-1:] * (corners - len(f))] for f in faces], dtype=int),
    }
    if unroll:
        arrays["places"] = unrolled(nodes)
    if not faces:
        del arrays["faces"]
    np.savez(model.with_suffix(".npz"), **arrays)
    return model.with_suffix(".npz")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("model", type=Path)
    parser.add_argument("--set", default="TOUCH")
    parser.add_argument("--unroll", action="store_true")
    options = parser.parse_args()
    print("wrote", convert(options.model, options.set, unroll=options.unroll))
