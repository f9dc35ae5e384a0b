"""Point loads: against ERAs of the same total, and refused values."""

import numpy as np

from model.fem.mesh import Mesh
from model.reduction.free_plate import solve_free_plate
from model.structure.attachments import Era, PointLoad
from model.structure.plate import Plate
from paper_plate import ALUMINIUM, LENGTH, WIDTH


def test_point_load_at_an_era_acts_as_bolt_mass_and_parallel_spring():
    """A mass and a damper laid on an ERA act as its own would, but are not driven by its base."""
    plate = Plate(LENGTH, WIDTH, 0.0015, ALUMINIUM)
    free = solve_free_plate(plate, Mesh(12, 9, LENGTH, WIDTH))
    places = [(0.0, 0.0), (LENGTH, 0.0), (0.1, WIDTH)]
    eras = [Era(f"E{n}", x, y, 17000.0, 2.0, 0.0, 1e-4) for n, (x, y) in enumerate(places)]
    heavier = [Era(e.name, e.x, e.y, 17000.0, 2.0, 0.01, 1e-4) for e in eras]
    masses = [PointLoad(x, y, mass=0.01) for x, y in places]
    frequencies = np.array([60.0, 110.0, 400.0])
    np.testing.assert_allclose(
        free.acceleration(eras, frequencies, free.mesh.nodes, loads=masses),
        free.acceleration(heavier, frequencies, free.mesh.nodes),
        rtol=1e-8,
    )
    # The base of an ERA with spring k + s and stroke a k / (k + s) pushes as one of k and a does.
    springs = [PointLoad(x, y, stiffness=3000.0, damping=0.3) for x, y in places]
    stiffer = [Era(e.name, e.x, e.y, 20000.0, 2.3, 0.0, 1e-4) for e in eras]
    omega = 2 * np.pi * frequencies
    share = (17000 + 2j * omega) / (20000 + 2.3j * omega)
    np.testing.assert_allclose(
        free.acceleration(eras, frequencies, free.mesh.nodes, loads=springs),
        free.acceleration(stiffer, frequencies, free.mesh.nodes) * share[:, None, None],
        rtol=1e-8,
    )
