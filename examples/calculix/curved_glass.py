"""Writes glass.inp: a curved glass with a cut-out and ribs as a model for CalculiX.

600 x 300 x 3 mm, bent about y to a radius of 1.5 m, one long edge a parabola (300 mm in the middle,
260 mm at the ends), a cut-out of 80 x 60 mm, and two ribs of aluminium below. The nodes of the face
that fingers touch are the set TOUCH. Units are m, kg and s.

    python examples/calculix/curved_glass.py
    ccx glass
    python examples/calculix/from_calculix.py glass --unroll
"""

import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np

LENGTH, WIDTH, NARROW, RADIUS = 0.6, 0.3, 0.26, 1.5  # m; the length is along the arc
GLASS, RIB = 3e-3, 8e-3  # m, thickness and height
MODES = 70

# Lines of the mesh: places along the arc [m], and shares of the width.
U = np.array([0, 22, 44, 66, 88, 114, 140, 160, 180, 200, 220, 240, 260, 280, 297, 303, 320, 340])
U = np.concatenate([U, [360, 380, 400, 422, 444, 466, 488, 510, 532, 554, 577, 600]]) * 1e-3
V = np.array([0, 6, 24, 42, 60, 78, 96, 115, 135, 155, 175, 195, 215, 236, 257, 279, 300]) / 300
CUT_OUT = slice(5, 9), slice(10, 13)  # elements along the arc and across it
RIBS = (slice(14, 15), slice(0, 16)), (slice(0, 29), slice(0, 1))

# Corners of a hexahedron, then the middles of its edges, in halves of an element (C3D20R).
_CORNERS = [(0, 0, 0), (2, 0, 0), (2, 2, 0), (0, 2, 0), (0, 0, 2), (2, 0, 2), (2, 2, 2), (0, 2, 2)]
_EDGES = [(0, 1), (1, 2), (2, 3), (3, 0), (4, 5), (5, 6), (6, 7), (7, 4)]
_EDGES += [(0, 4), (1, 5), (2, 6), (3, 7)]
HEXAHEDRON = np.array(
    [*_CORNERS, *(np.add(_CORNERS[a], _CORNERS[b]) // 2 for a, b in _EDGES)], dtype=int
)
TOP = 2
"""Layer of the touch face, in halves of an element; the bottom of the glass is 0, of ribs -2."""


def place(i: np.ndarray, j: np.ndarray) -> np.ndarray:
    """Return places (n, 2) [m] along and across the arc of half lines i, j (n,) of the mesh."""
    u, share = np.interp(i / 2, range(len(U)), U), np.interp(j / 2, range(len(V)), V)
    return np.column_stack([u, share * edge(u)])


def edge(u: np.ndarray) -> np.ndarray:
    """Return how wide the glass is at u [m] along its arc."""
    return WIDTH - (WIDTH - NARROW) * (2 * u / LENGTH - 1) ** 2


def elements() -> Iterator[tuple[str, np.ndarray]]:
    """Yield each element with its material, first half lines and layer."""
    solid = np.ones((len(U) - 1, len(V) - 1), dtype=bool)
    solid[CUT_OUT] = False
    for i, j in np.argwhere(solid):
        yield "GLASS", np.array([2 * i, 2 * j, 0])
    ribs = np.zeros_like(solid)
    for rib in RIBS:
        ribs[rib] = True
    for i, j in np.argwhere(ribs & solid):
        yield "RIB", np.array([2 * i, 2 * j, -2])


def write_model(path: Path, *, solver: str = "") -> dict[tuple[int, int, int], int]:
    """Write the model; return its nodes by half lines and layer.

    solver: further words of its *FREQUENCY.
    """
    found: dict[tuple[int, int, int], int] = {}
    rows: dict[str, list[list[int]]] = {"GLASS": [], "RIB": []}
    for material, first in elements():
        at = [tuple(int(each) for each in first + own) for own in HEXAHEDRON]
        rows[material].append([found.setdefault(each, len(found) + 1) for each in at])
    at = np.array(list(found))
    u, v = place(at[:, 0], at[:, 1]).T
    depth = np.interp(at[:, 2], [-2, 0, TOP], [-GLASS - RIB, -GLASS, 0])
    angle = (u - LENGTH / 2) / RADIUS
    r = RADIUS + depth
    xyz = np.column_stack([r * np.sin(angle), v, r * np.cos(angle) - RADIUS])
    lines = ["*NODE, NSET=ALL"]
    lines += [f"{n}, " + ", ".join(f"{each:.12g}" for each in p) for n, p in enumerate(xyz, 1)]
    number = 0
    for name, nodes in rows.items():
        lines.append(f"*ELEMENT, TYPE=C3D20R, ELSET={name}")
        for each in nodes:
            number += 1
            whole = [str(entry) for entry in (number, *each)]
            lines += [", ".join(whole[:11]) + ",", ", ".join(whole[11:])]
    touch = [str(n) for at, n in found.items() if at[2] == TOP]
    lines += ["*NSET, NSET=TOUCH", *(", ".join(touch[n : n + 8]) for n in range(0, len(touch), 8))]
    for name, modulus, poisson, density in (
        ("GLASS", 72e9, 0.22, 2500),
        ("RIB", 70e9, 0.33, 2700),
    ):
        lines += [f"*MATERIAL, NAME={name}", "*ELASTIC", f"{modulus:g}, {poisson:g}"]
        lines += ["*DENSITY", f"{density:g}", f"*SOLID SECTION, ELSET={name}, MATERIAL={name}"]
    lines += ["*STEP", f"*FREQUENCY{solver}", f"{MODES}", "*NODE FILE", "U", "*END STEP", ""]
    path.write_text("\n".join(lines), encoding="ascii")
    return found


if __name__ == "__main__":
    write_model(Path(sys.argv[1] if len(sys.argv) > 1 else "glass.inp"))
