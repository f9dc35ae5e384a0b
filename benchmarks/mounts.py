"""What the size of a mount changes, by its stiffness: `python -m benchmarks.mounts`.

Four mounts 30 mm within the corners of the paper's plate, in polynomials of `mesh: auto`, against
elements of fifth order that resolve a patch, and a point against the patch.
"""

import numpy as np

from benchmarks.setting import RIG
from model.arrays import ComplexArray, FloatArray
from model.fem.mesh import Mesh, element_of
from model.reduction.free_plate import solve_free_plate
from model.rig.file import load_rig
from model.spectral.mesh import SpectralMesh
from model.structure.attachments import Era

PLATE = load_rig(RIG).plate
FREQUENCIES = np.array([110.0, 250.0, 400.0])
INSET = 0.03


def main() -> None:
    """Print the table."""
    sides = (PLATE.length, PLATE.width)
    mesh = Mesh(24, 18, *sides, element=element_of("Q5"), strip=3e-3)
    elements = solve_free_plate(PLATE, mesh, frequency_max=400.0)
    x, y = np.meshgrid(*(np.linspace(0.05, 0.95, 7) * side for side in sides))
    points = np.column_stack([x.ravel(), y.ravel()])
    columns = " | ".join(f"{frequency:g} Hz" for frequency in FREQUENCIES)
    print(f"| stiffness | radius | `mesh: auto` | {columns} |")
    print("|---|---|---|" + "---|" * len(FREQUENCIES))
    for stiffness in (1e5, 1e6, 1e7, 1e8):
        for foot in (2e-3, 5e-3, 10e-3):
            polynomials = SpectralMesh.accurate(
                PLATE, frequency_max=400.0, accuracy=0.01, stiffness=stiffness, foot=foot
            )
            assert polynomials is not None
            free = solve_free_plate(PLATE, polynomials, frequency_max=400.0)
            exact = elements.acceleration(_mounts(stiffness, foot), FREQUENCIES, points)
            found = free.acceleration(_mounts(stiffness, foot), FREQUENCIES, points)
            point = elements.acceleration(_mounts(stiffness, 0.0), FREQUENCIES, points)
            changes = " | ".join(f"{each:.1f} %" for each in _difference(point, exact))
            print(
                f"| {stiffness / 1e6:g} MN/m | {1e3 * foot:g} mm | "
                f"{_difference(found, exact).max():.2f} % | {changes} |"
            )


def _mounts(stiffness: float, foot: float) -> list[Era]:
    x, y = (INSET, PLATE.length - INSET), (INSET, PLATE.width - INSET)
    return [
        Era(
            f"{a}{b}", a, b, stiffness=stiffness, damping=2.0, bolt_mass=0.0, stroke=1e-4, foot=foot
        )
        for a in x
        for b in y
    ]


def _difference(one: ComplexArray, other: ComplexArray) -> FloatArray:
    """Relative L2 difference [%] over the points, the largest of all driven mounts, (f,)."""
    size = np.linalg.norm(one - other, axis=2) / np.linalg.norm(other, axis=2)
    return np.asarray(100 * size.max(axis=1))


if __name__ == "__main__":
    main()
