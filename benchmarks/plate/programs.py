"""Programs with their measured settings, from coarse to fine.

Settings of the peer were chosen by trial on the paper's plate, among orders 3 to 10, one to eight
elements a side, strips of 0 to 5 mm and 12 to 60 modes. era-haptics
solves the free plate in polynomials once, on `mesh: auto A %`.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

from benchmarks.plate.peers.meshes import Elements
from benchmarks.plate.peers.ways import Direct, Matrices, Modes
from benchmarks.plate.problem import (
    CAR,
    DAMPING,
    PAPER,
    PAPER_ON_FEET,
    STIFFNESS,
    STROKE,
    TABLE,
    Case,
)
from model.arrays import ComplexArray, FloatArray
from model.reduction import free_plate
from model.reduction.free_plate import solve_free_plate
from model.rig.rig_mesh import mesh_of
from model.spectral import polynomials
from model.structure.sources import Era

NAME = "era-haptics"


class Spectral:
    """The solved plate, for an accuracy as `1 %`."""

    def __init__(self, case: Case, accuracy: str) -> None:
        self.case = case
        high = case.highest
        mesh = mesh_of(
            f"auto {accuracy}",
            case.plate,
            frequency_max=high,
            stiffness=STIFFNESS,
            foot=case.foot,
        )
        self.free = solve_free_plate(case.plate, mesh, frequency_max=high)

    def sweep(self, shares: FloatArray) -> ComplexArray:
        """Acceleration (f, eras, p) with ERAs at shares (n, 2) of the sides."""
        eras = eras_at(self.case, shares)
        return self.free.acceleration(eras, self.case.frequencies, self.case.points)

    def sweeps(self, layouts: Sequence[FloatArray]) -> list[ComplexArray]:
        """The same for several layouts."""
        return [self.sweep(layout) for layout in layouts]


def eras_at(case: Case, shares: FloatArray) -> list[Era]:
    """ERAs at shares (n, 2) of the sides."""
    return [
        Era(f"E{number}", x, y, STIFFNESS, DAMPING, 0.0, STROKE, foot=foot)
        for number, (x, y, foot) in enumerate(case.footprints(shares).tolist())
    ]


def forget() -> None:
    """Clear caches that plates share: one-dimensional integrals, weights."""
    for module in (polynomials, free_plate):
        for kept in vars(module).values():
            if hasattr(kept, "cache_clear"):
                kept.cache_clear()


ACCURACIES = (2.0, 1.0, 0.5, 0.1)
"""Errors to reach, in per cent."""

CASES = {PAPER: ACCURACIES, PAPER_ON_FEET: ACCURACIES, CAR: (1.0,), TABLE: (1.0,)}
"""Problems with the errors to reach."""

# order, elements along x and y, strips in thirds of the thickness (1.5 mm: 0.5 mm), modes
_MODES: dict[Case, list[tuple[int, int, int, tuple[int, ...], int]]] = {
    PAPER: [
        (5, 2, 2, (8,), 18), (6, 2, 2, (6,), 24), (6, 2, 2, (6,), 32), (6, 3, 3, (2, 8), 24),
        (6, 4, 3, (8,), 20), (6, 4, 4, (8,), 20), (6, 6, 5, (8,), 32),
    ],
    CAR: [(6, 4, 3, (8,), 48), (6, 5, 4, (8,), 56), (7, 6, 4, (8,), 64)],
    TABLE: [(6, 4, 3, (8,), 48), (6, 5, 4, (8,), 56), (7, 6, 4, (8,), 64)],
}  # fmt: skip
_DIRECT: dict[Case, list[tuple[int, int, int, tuple[int, ...]]]] = {
    PAPER: [(4, 3, 3, (8,)), (5, 2, 2, (8,)), (6, 2, 2, (8,)), (6, 4, 4, (8,)), (6, 6, 5, (8,))],
}
# Larger plates need more elements: 8x8 have an error of 1 % inside the car's glass, because they do
# not resolve the local deflection under a force.
_REFERENCE = (6, 8, 8, (1.4, 3, 8))
_REFERENCES = {CAR: (6, 18, 10, (1.4, 3, 8)), TABLE: (6, 14, 10, (1.4, 3, 8))}


class Solved(Protocol):
    """A solved plate, or a plate with its matrices."""

    def sweep(self, shares: FloatArray) -> ComplexArray:
        """Acceleration (f, eras, p) with ERAs at shares (n, 2) of the sides."""

    def sweeps(self, layouts: Sequence[FloatArray]) -> list[ComplexArray]:
        """The same for several layouts of equally many ERAs."""


@dataclass(frozen=True)
class Setting:
    """A program with a method and a mesh; `solve` starts without any cached result."""

    program: str
    way: str
    mesh: str
    solve: Callable[[], Solved]

    @property
    def name(self) -> str:
        """Program and method."""
        return f"{self.program}, {self.way}" if self.way else self.program


def settings(case: Case) -> list[Setting]:
    """Return all settings for a case, era-haptics first."""

    def by_us(accuracy: float) -> Setting:
        def solve() -> Solved:
            forget()
            return Spectral(case, f"{accuracy:g} %")

        return Setting(NAME, "", f"auto {accuracy:g} %", solve)

    def direct(order: int, nx: int, ny: int, strips: tuple[int, ...]) -> Setting:
        elements = _elements(case, order, nx, ny, strips)
        return Setting(
            "NGSolve",
            Direct.way,
            f"{elements}",
            lambda: Direct(case, _matrices(case, elements)),
        )

    def modes(order: int, nx: int, ny: int, strips: tuple[int, ...], count: int) -> Setting:
        elements = _elements(case, order, nx, ny, strips)
        return Setting(
            "NGSolve",
            Modes.way,
            f"{elements}, {count} modes",
            lambda: Modes(case, _matrices(case, elements), count),
        )

    like = PAPER if case is PAPER_ON_FEET else case
    found = [by_us(accuracy) for accuracy in CASES[case]]
    found += [direct(*each) for each in _DIRECT.get(like, [])]
    found += [modes(*each) for each in _MODES[like]]
    return found


def reference(case: Case) -> Direct:
    """Return the reference, with graded strips."""
    elements = _elements(case, *_REFERENCES.get(case, _REFERENCE))
    return Direct(case, _matrices(case, elements))


def _matrices(case: Case, elements: Elements) -> Matrices:
    """Matrices by NGSolve, which is loaded only here."""
    from benchmarks.plate.peers import ngsolve_plate

    return ngsolve_plate.Matrices(case, elements)


def _elements(case: Case, order: int, nx: int, ny: int, strips: tuple[float, ...]) -> Elements:
    unit = case.plate.thickness / 3
    return Elements(order, nx, ny, tuple(unit * width for width in strips))
