"""The plate in a few coordinates: against the full one, its slopes, modes and what was left out."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.direct_plate import direct_acceleration
from model.arrays import FloatArray
from model.fem import ELEMENTS, Mesh, assemble
from model.reduction.free_plate import truncation_weights
from model.reduction.reduced_plate import (
    SupportedModes,
    place_slopes,
    reduce_plate,
    supported_modes,
)
from model.rig.rig import Rig
from model.structure.attachments import Era, damping_from_ratio, footprints_of
from model.structure.plate import Plate
from plates import ALUMINIUM, LENGTH, WIDTH, make_paper_rig

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


SIDES = np.array([0.3, 0.2])
WAVES = np.array([[20.0, 0.0], [35.0, -60.0], [0.0, 90.0]])  # rad/m


def test_slopes_are_those_of_waves() -> None:
    """Inside, beside edges and at corners, to 2e-6 of the wave number, from points on the plate."""
    places = np.array([[0.1, 0.05], [0.0, 0.12], [0.3, 0.2], [1e-7, 0.2], [0.12, 0.2 - 1e-7]])
    places = np.column_stack([places, np.full(len(places), 0.01)])

    def field(at: FloatArray) -> FloatArray:
        assert ((at[:, :2] >= 0) & (at[:, :2] <= SIDES)).all()
        assert (at[:, 2] == 0.01).all()
        return np.asarray(np.sin(at[:, :2] @ WAVES.T))

    exact = np.cos(places[:, :2] @ WAVES.T)[:, None] * WAVES.T
    np.testing.assert_allclose(place_slopes(field, places, SIDES), exact, atol=2e-6 * 90)


LARGEST = 1 / 4.0e7  # the lowest truncated mode at about 1 kHz


def approximation(zeta, u, terms):
    """Sum of the weights times (u / u_c)^j."""
    powers = (u[:, None] / LARGEST) ** np.arange(1, terms + 1)
    return powers @ truncation_weights(np.array([zeta]), LARGEST, terms)[0]


def error_bound(zeta, terms):
    """1 / |T_k(t)| at t = 2 / (u_c zeta) - 1, by |T_k| = |cosh(k arccosh t)|."""
    return 1 / abs(np.cosh(terms * np.arccosh(2 / (LARGEST * complex(zeta)) - 1)))


@pytest.mark.parametrize("terms", [1, 3, 4, 8])
@pytest.mark.parametrize("zeta", [1e3, 1e6, 1e7, 1e7 - 1e5j, 3e7])
def test_truncation_weights_reach_the_error_of_a_chebyshev_polynomial(zeta, terms):
    """Over the whole interval the relative error reaches its bound and does not exceed it."""
    u = LARGEST * np.linspace(1e-6, 1, 2001)
    exact = u / (1 - zeta * u)
    error = np.abs(approximation(zeta, u, terms) / exact - 1).max()
    bound = error_bound(zeta, terms)
    assert error < 1.001 * bound + 1e-11
    assert error > 0.9 * bound or bound < 1e-9


def modes_of(rig: Rig, *, frequency_max: float) -> SupportedModes:
    """Those of a rig's plate on its mesh."""
    attached = footprints_of(rig.eras)
    reduced = reduce_plate(rig.plate, rig.mesh, attached, frequency_max=frequency_max)
    return supported_modes(reduced, rig.eras, frequency_max=frequency_max)


def test_damping_ratio_of_a_rigid_plate_as_by_hand() -> None:
    """Bouncing has the ratio zeta, tilting nearly sqrt(3) times that.

    Mass m on four corners of k and c = 2 zeta sqrt(k m / 4): bouncing 4 c / (2 sqrt(4 k m)).
    Tilting along a side b has the inertia m (b² + h²) / 12, and k b², c b².
    """
    rig = make_paper_rig(12, 9)
    plate = replace(rig.plate, thickness=0.03, loss_factor=0.0)  # bends at a thousand hertz
    damping = damping_from_ratio(0.05, stiffness=17000.0, plate_mass=plate.mass, era_count=4)
    eras = tuple(replace(era, damping=damping) for era in rig.eras)
    mesh = Mesh.accurate(plate, frequency_max=100.0)
    found = modes_of(replace(rig, plate=plate, eras=eras, mesh=mesh), frequency_max=100.0)
    tilting = [
        0.05 * np.sqrt(3 / (1 + (plate.thickness / side) ** 2))
        for side in (plate.width, plate.length)
    ]
    np.testing.assert_allclose(found.damping_ratios, [0.05, *tilting], rtol=2e-3)
    bouncing = np.sqrt(4 * 17000.0 / plate.mass) / (2 * np.pi)
    np.testing.assert_allclose(found.natural_frequencies[0], bouncing, rtol=1e-3)
