"""The plate in a few dozen coordinates, against the direct solve."""

import numpy as np
import pytest

from model.fem.mesh import ELEMENTS, Mesh
from model.fem.plate import assemble, direct_acceleration
from model.reduction.reduced_plate import reduce_plate
from model.structure.attachments import Era, footprints_of
from model.structure.plate import Plate
from paper_plate import ALUMINIUM, LENGTH, WIDTH

PLATE = Plate(LENGTH, WIDTH, 0.0015, ALUMINIUM)
MESH = Mesh(6, 5, LENGTH, WIDTH, ELEMENTS["Q4"], 0.003)
CORNERS = [(0.0, 0.0), (LENGTH, 0.0), (LENGTH, WIDTH), (0.0, WIDTH)]
INSIDE = [(0.051, 0.017), (0.29, 0.08), (0.12, WIDTH)]


@pytest.mark.parametrize("places", [CORNERS, [*INSIDE, INSIDE[0]]])
def test_reduced_plate_response_equals_direct_solve(places):
    """Its equations, solved frequency by frequency, are within 3e-5.

    Relative L2 over the plate, against the direct solve of the same mesh.
    Two ERAs at one place need the same static vectors: one set of them is dropped.
    """
    eras = [
        Era(f"E{n}", x, y, 17000.0 * (n + 1), 3.0, 0.004 * n, 1e-4)
        for n, (x, y) in enumerate(places)
    ]
    frequencies = np.array([31.7, 68.1, 110.0, 250.0, 444.0, 500.0])
    reduced = reduce_plate(PLATE, MESH, footprints_of(eras))
    touch, observe = reduced.at(footprints_of(eras)), reduced.at(MESH.nodes)
    direct = direct_acceleration(assemble(PLATE, MESH), eras, frequencies, MESH.nodes)
    for row, omega in enumerate(2 * np.pi * frequencies):
        spring = np.array([era.stiffness + 1j * omega * era.damping for era in eras])
        attached = spring - omega**2 * np.array([era.bolt_mass for era in eras])
        dynamic = np.diag((1 + 0.01j) * reduced.omega**2 - omega**2) + (touch.T * attached) @ touch
        answer = -(omega**2) * observe @ np.linalg.solve(dynamic, touch.T * spring * 1e-4)
        error = np.linalg.norm(answer.T - direct[row], axis=1)
        error /= np.linalg.norm(direct[row], axis=1)
        assert error.max() < 3e-5


def test_projection_carries_motion_to_another_reduction():
    """To more points nothing is lost; to fewer, or others, it is the mass-weighted projection.

    Which is the same seen from either side, and exact at the points that both answer for.
    """
    small = reduce_plate(PLATE, MESH, np.array(CORNERS))
    large = small.with_attachments_at(np.array(INSIDE))
    other = small.with_attachments_at(np.array([[0.2, 0.1]]))
    up, down = large.projection_from(small), small.projection_from(large)
    np.testing.assert_allclose(up.T @ up, np.eye(len(small.omega)), atol=1e-9)
    np.testing.assert_allclose(down, up.T, atol=1e-9)
    np.testing.assert_allclose(
        large.at(MESH.nodes) @ up,
        small.at(MESH.nodes),
        atol=1e-8 * np.abs(small.at(MESH.nodes)).max(),
    )
    across = other.projection_from(large)
    np.testing.assert_allclose(across, large.projection_from(other).T, atol=1e-9)
    through_small = other.projection_from(small) @ down
    np.testing.assert_allclose(across @ up, through_small @ up, atol=1e-9)
    assert np.linalg.norm(across - through_small) > 0.1
