"""era-haptics: the free plate in polynomials solved once, on `mesh: auto A %`."""

from collections.abc import Sequence

from benchmarks.plate.problem import DAMPING, STIFFNESS, STROKE, Case
from model.arrays import ComplexArray, FloatArray
from model.reduction import free_plate
from model.reduction.free_plate import solve_free_plate
from model.rig.rig_file import mesh_of
from model.spectral import polynomials
from model.structure.attachments import Era

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
    """Forget what is kept from one plate to the next: integrals of one dimension, weights."""
    for module in (polynomials, free_plate):
        for kept in vars(module).values():
            if hasattr(kept, "cache_clear"):
                kept.cache_clear()
