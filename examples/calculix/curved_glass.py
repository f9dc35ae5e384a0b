"""Write a CalculiX model of a curved glass with a cut-out and ribs, glass.inp.

The glass is 600 x 300 x 3 mm, bent about y to a radius of 1.5 m. One long edge is a parabola
(300 mm wide in the middle, 260 mm at the ends). It has a cut-out of 80 x 60 mm and two aluminium
ribs below. The node set TOUCH is the touched face. Units are m, kg and s.

    python examples/calculix/curved_glass.py
    ccx glass
    python examples/calculix/from_calculix.py glass --unroll
"""

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TypeAlias

import numpy as np

LENGTH, WIDTH, NARROW, RADIUS = 0.6, 0.3, 0.26, 1.5  # m; the length is along the arc
GLASS, RIB = 3e-3, 8e-3  # m, thickness and height
MODES = 70

# Mesh lines: positions along the arc [m], and positions across it relative to the width.
U = np.array([0, 22, 44, 66, 88, 114, 140, 160, 180, 200, 220, 240, 260, 280, 297, 303, 320, 340])
U = np.concatenate([U, [360, 380, 400, 422, 444, 466, 488, 510, 532, 554, 577, 600]]) * 1e-3
V = np.array([0, 6, 24, 42, 60, 78, 96, 115, 135, 155, 175, 195, 215, 236, 257, 279, 300]) / 300
CUT_OUT = slice(5, 9), slice(10, 13)  # elements along the arc and across it
RIBS = (slice(14, 15), slice(0, 16)), (slice(0, 29), slice(0, 1))

# Corners and edge midpoints of a hexahedron (C3D20R), in half elements.
_CORNERS = [(0, 0, 0), (2, 0, 0), (2, 2, 0), (0, 2, 0), (0, 0, 2), (2, 0, 2), (2, 2, 2), (0, 2, 2)]
_EDGES = [(0, 1), (1, 2), (2, 3), (3, 0), (4, 5), (5, 6), (6, 7), (7, 4)]
_EDGES += [(0, 4), (1, 5), (2, 6), (3, 7)]
HEXAHEDRON = np.array(
    [*_CORNERS, *(np.add(_CORNERS[a], _CORNERS[b]) // 2 for a, b in _EDGES)], dtype=int
)
GridPoint: TypeAlias = tuple[int, int, int]
"""Half line along the arc, half line across it, and layer of a node."""

TOP = 2
"""Layer of the touched face in half elements; 0: bottom of the glass, -2: bottom of the ribs."""


def position(i: np.ndarray, j: np.ndarray) -> np.ndarray:
    """Return positions (n, 2) [m] along and across the arc, for mesh half lines i, j (n,)."""
    along = np.interp(i / 2, range(len(U)), U)
    relative = np.interp(j / 2, range(len(V)), V)
    return np.column_stack([along, relative * width_at(along)])


def width_at(u: np.ndarray) -> np.ndarray:
    """Return the width of the glass [m] at u [m] along its arc."""
    return WIDTH - (WIDTH - NARROW) * (2 * u / LENGTH - 1) ** 2


def elements() -> Iterator[tuple[str, np.ndarray]]:
    """Yield the material of each element, and its first half lines and layer."""
    solid = np.ones((len(U) - 1, len(V) - 1), dtype=bool)
    solid[CUT_OUT] = False
    for i, j in np.argwhere(solid):
        yield "GLASS", np.array([2 * i, 2 * j, 0])
    ribs = np.zeros_like(solid)
    for rib in RIBS:
        ribs[rib] = True
    for i, j in np.argwhere(ribs & solid):
        yield "RIB", np.array([2 * i, 2 * j, -2])


def write_model(path: Path, *, solver: str = "") -> dict[GridPoint, int]:
    """Write the model; return its node numbers by half lines and layer.

    solver: additional parameters of *FREQUENCY.
    """
    numbers: dict[GridPoint, int] = {}
    element_nodes: dict[str, list[list[int]]] = {"GLASS": [], "RIB": []}
    for material, first in elements():
        nodes = []
        for offset in HEXAHEDRON:
            i, j, layer = (first + offset).tolist()
            nodes.append(numbers.setdefault((i, j, layer), len(numbers) + 1))
        element_nodes[material].append(nodes)
    lines = [
        *node_lines(numbers),
        *element_lines(element_nodes),
        *touch_lines(numbers),
        *material_lines("GLASS", modulus=72e9, poisson=0.22, density=2500),
        *material_lines("RIB", modulus=70e9, poisson=0.33, density=2700),
    ]
    lines += ["*STEP", f"*FREQUENCY{solver}", f"{MODES}", "*NODE FILE", "U", "*END STEP", ""]
    path.write_text("\n".join(lines), encoding="ascii")
    return numbers


def node_lines(numbers: dict[GridPoint, int]) -> Iterator[str]:
    """Yield the nodes with their coordinates [m]."""
    points = np.array(list(numbers))
    along, across = position(points[:, 0], points[:, 1]).T
    depth = np.interp(points[:, 2], [-2, 0, TOP], [-GLASS - RIB, -GLASS, 0])
    angle = (along - LENGTH / 2) / RADIUS
    radius = RADIUS + depth
    x = radius * np.sin(angle)
    z = radius * np.cos(angle) - RADIUS
    yield "*NODE, NSET=ALL"
    for number, coordinates in enumerate(np.column_stack([x, across, z]), start=1):
        yield f"{number}, " + ", ".join(f"{value:.12g}" for value in coordinates)


def element_lines(element_nodes: dict[str, list[list[int]]]) -> Iterator[str]:
    """Yield the elements of each material; an element takes two lines."""
    number = 0
    for material, elements_of_material in element_nodes.items():
        yield f"*ELEMENT, TYPE=C3D20R, ELSET={material}"
        for nodes in elements_of_material:
            number += 1
            entries = [str(entry) for entry in (number, *nodes)]
            yield ", ".join(entries[:11]) + ","
            yield ", ".join(entries[11:])


def touch_lines(numbers: dict[GridPoint, int]) -> Iterator[str]:
    """Yield the node set of the touched face, eight nodes per line."""
    touch = [str(number) for point, number in numbers.items() if point[2] == TOP]
    yield "*NSET, NSET=TOUCH"
    for start in range(0, len(touch), 8):
        yield ", ".join(touch[start : start + 8])


def material_lines(name: str, *, modulus: float, poisson: float, density: float) -> tuple[str, ...]:
    """Return a material (SI units), and the section that assigns it to its elements."""
    return (
        f"*MATERIAL, NAME={name}",
        "*ELASTIC",
        f"{modulus:g}, {poisson:g}",
        "*DENSITY",
        f"{density:g}",
        f"*SOLID SECTION, ELSET={name}, MATERIAL={name}",
    )


if __name__ == "__main__":
    write_model(Path(sys.argv[1] if len(sys.argv) > 1 else "glass.inp"))
