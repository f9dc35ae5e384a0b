"""era-haptics: the free plate solved once, on a peer's mesh or of order 5 with strips."""

from benchmarks.plate.problem import (
    DAMPING,
    FREQUENCIES,
    LENGTH,
    LOSS_FACTOR,
    NU,
    RHO,
    STIFFNESS,
    STROKE,
    THICKNESS,
    WIDTH,
    E,
)  # fmt: skip
from model.arrays import ComplexArray, FloatArray, IntArray
from model.fem.mesh import Mesh
from model.reduction.free_plate import solve_free_plate
from model.structure.actuator import Era
from model.structure.plate import Material
from model.structure.plate import Plate as PlateOf
from model.studies.receptances import Receptances

NAME = "era-haptics"
METHOD = "Reissner-Mindlin, MITC4"


class Plate:
    """The free plate on nx by ny elements; 0 by 0: 10x8 of order 5 with strips."""

    def __init__(self, nx: int, ny: int) -> None:
        plate = PlateOf(LENGTH, WIDTH, THICKNESS, Material("aluminium", E, RHO, NU), LOSS_FACTOR)
        mesh = Mesh(nx, ny, LENGTH, WIDTH) if nx else Mesh.accurate(plate, frequency_max=500.0)
        self.free = solve_free_plate(plate, mesh)
        self.points = mesh.nodes
        self.dof = 3 * mesh.node_count

    def sweep(self, places: FloatArray, observed: FloatArray) -> ComplexArray:
        return self.free.acceleration(eras_at(places), FREQUENCIES, observed)


class Candidates:
    """The same plate, solved for a raster of positions before the first layout."""

    def __init__(self, plate: Plate, places: FloatArray, observed: FloatArray) -> None:
        self.places = places
        between, to_points = plate.free.receptances(places, observed, FREQUENCIES)
        self.receptances = Receptances(FREQUENCIES, between, to_points)

    def sweep(self, numbers: IntArray) -> ComplexArray:
        return self.receptances.acceleration(numbers, tuple(eras_at(self.places[numbers])))


def eras_at(places: FloatArray) -> list[Era]:
    """ERAs at places (n, 2) [m]."""
    return [
        Era(f"E{number}", x, y, STIFFNESS, DAMPING, 0.0, STROKE)
        for number, (x, y) in enumerate(places.tolist())
    ]
