"""The free plate with anything attached to it, against the direct solve of the same mesh."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import sparse
from scipy.sparse.linalg import splu

from benchmarks.direct_plate import direct_acceleration
from model.errors import InputError
from model.fem import ELEMENTS, Mesh, assemble
from model.reduction.free_plate import FreePlate, solve_free_plate
from model.spectral.modes import SpectralMesh
from model.structure.attachments import Era, PointLoad
from model.structure.plate import Laminate, LaminateLayer, Plate
from model.vibration import natural_modes
from plates import ALUMINIUM, LENGTH, WIDTH, make_paper_rig

# Even and odd counts of elements, low and high order, with strips along the edges and without.
MESHES = {
    "16x12": Mesh(16, 12, LENGTH, WIDTH),
    "15x11": Mesh(15, 11, LENGTH, WIDTH),
    "4x3 Q4": Mesh(4, 3, LENGTH, WIDTH, ELEMENTS["Q4"], 0.003),
}


@pytest.fixture(scope="module", params=MESHES)
def free(request: pytest.FixtureRequest) -> FreePlate:
    """The paper's plate, solved once for every layout that follows."""
    return solve_free_plate(Plate(LENGTH, WIDTH, 0.0015, ALUMINIUM), MESHES[request.param])


def random_eras(rng: np.random.Generator, count: int) -> tuple[Era, ...]:
    """ERAs anywhere, from hardly there (10 N/m) to as good as clamped (1e8 N/m)."""
    return tuple(
        Era(
            f"E{number}",
            x=rng.uniform(0, LENGTH),
            y=rng.choice([0, WIDTH, rng.uniform(0, WIDTH)]),
            stiffness=10 ** rng.uniform(1, 8),
            damping=10 ** rng.uniform(-2, 2),
            bolt_mass=rng.choice([0.0, 0.003, 0.05]),
            stroke=1e-4,
        )
        for number in range(count)
    )


def random_loads(rng: np.random.Generator) -> tuple[PointLoad, ...]:
    """Up to three fingers and a mass, anywhere."""
    fingers = tuple(
        PointLoad(rng.uniform(0, LENGTH), rng.uniform(0, WIDTH), 10 ** rng.uniform(2, 4), 2.0, 2e-4)
        for _ in range(rng.integers(0, 4))
    )
    return (*fingers, PointLoad(rng.uniform(0, LENGTH), rng.uniform(0, WIDTH), mass=0.02))


def test_acceleration_equals_direct_solve_for_any_layout(free):
    """One solved plate is within 1e-4 (relative L2) of a direct solve.

    One to six ERAs of any stiffness, bolts, fingers, a mass; frequencies anywhere up to 500 Hz and
    at a resonance of each layout.
    """
    rng = np.random.default_rng(7)
    matrices = assemble(free.plate, free.mesh)
    points = free.mesh.nodes[::3]
    for _ in range(3):
        eras, loads = random_eras(rng, rng.integers(1, 7)), random_loads(rng)
        rig = replace(make_paper_rig(12, 9), eras=eras)
        natural = natural_modes(rig, 12, support="eras", mesh=free.mesh).frequencies
        resonance = rng.choice(natural[(natural > 5) & (natural < 500)])
        frequencies = np.array([*rng.uniform(5, 500, 3), resonance, 500.0])
        direct = direct_acceleration(matrices, eras, frequencies, points, loads=loads)
        quick = free.acceleration(eras, frequencies, points, loads=loads)
        error = np.linalg.norm(quick - direct, axis=2) / np.linalg.norm(direct, axis=2)
        assert error.max() < 1e-4


PAPER = Plate(LENGTH, WIDTH, 0.0015, ALUMINIUM)
BAR = (Era("A", 0.3, 1.0, 1e4, 1.0, 0.0, 1e-4), Era("B", 0.0, 0.0, 1e4, 1.0, 0.0, 1e-4))
SPREAD = (
    Era("A", 0.16, 0.09, 3e4, 0.0, 0.01, 1e-4),
    Era("B", 0.95, 0.35, 1e5, 0.0, 0.0, 1e-4),
    Era("C", 0.39, 1.0, 8e3, 0.0, 0.0, 1e-4),
)


@pytest.mark.parametrize(
    ("plate", "mesh", "eras"),
    [
        (replace(PAPER, loss_factor=0.0), (24, 18), SPREAD),  # no damping to hide behind
        (Plate(0.3, 0.2, 0.02, ALUMINIUM), (3, 3, "Q4"), SPREAD),  # only rocks up to 500 Hz
        (Plate(1.0, 0.02, 0.002, ALUMINIUM), (60, 3), BAR),  # many modes in a row
        (Plate(0.05, 0.4, 0.002, ALUMINIUM), (4, 40), BAR),
        (Plate(0.03, 0.03, 0.002, ALUMINIUM), (1, 1), BAR),  # hardly any degrees of freedom
        (Plate(0.03, 0.03, 0.002, ALUMINIUM), (2, 1), BAR),
    ],
    ids=["undamped", "block", "bar", "standing bar", "one element", "two elements"],
)
def test_acceleration_equals_direct_solve_for_extreme_plates(plate, mesh, eras):
    """Within 1e-4 (relative L2); places of the ERAs are shares of the sides."""
    nx, ny, *names = mesh
    mesh = Mesh(nx, ny, plate.length, plate.width, *(ELEMENTS[name] for name in names))
    eras = tuple(replace(era, x=era.x * plate.length, y=era.y * plate.width) for era in eras)
    frequencies = np.array([40.0, 187.0, 333.0, 471.0])
    direct = direct_acceleration(assemble(plate, mesh), eras, frequencies, mesh.nodes)
    quick = solve_free_plate(plate, mesh).acceleration(eras, frequencies, mesh.nodes)
    error = np.linalg.norm(quick - direct, axis=2) / np.linalg.norm(direct, axis=2)
    assert error.max() < 1e-4


@pytest.mark.parametrize(
    ("frequency", "x", "mesh", "message"),
    [
        (0.0, 0.1, (12, 9), "^frequency must be"),
        (float("nan"), 0.1, (12, 9), "^frequency must be"),
        (501.0, 0.1, (12, 9), "^frequency must be"),
        # The wave at 450 Hz is 180 mm, an element 51 mm; six nodes to a wavelength are needed.
        (450.0, 0.1, (6, 5), "resolves, got 450 Hz"),
        (100.0, LENGTH + 0.01, (12, 9), "must be on the plate"),
        (100.0, -0.01, (12, 9), "must be on the plate"),
    ],
)
def test_acceleration_refuses_values_out_of_range(frequency, x, mesh, message):
    """Frequencies not solved for or too high for the mesh; ERAs and points off the plate."""
    free = solve_free_plate(PAPER, Mesh(*mesh, LENGTH, WIDTH))
    eras, frequencies = random_eras(np.random.default_rng(0), 3), np.array([100.0, frequency])
    with pytest.raises(InputError, match=message):
        free.acceleration(eras, frequencies, np.array([[x, 0.1]]))
    with pytest.raises(InputError, match=message):
        free.acceleration((replace(eras[0], x=x),), frequencies, free.mesh.nodes)


def test_truncated_sums_of_a_soft_plate_are_the_same_both_ways():
    """Reciprocity, and no sum below zero: its kept modes move a million times as far."""
    plate = Plate(1.2, 0.8, 0.004, ALUMINIUM)
    modes = solve_free_plate(plate, Mesh(4, 4, plate.length, plate.width)).modes
    points = np.random.default_rng(5).uniform(0, [plate.length, plate.width], (9, 2))
    for sums in modes.truncated_terms(points, points):
        assert sums == pytest.approx(sums.T, abs=1e-9 * np.abs(sums).max())
        assert np.linalg.eigvalsh(sums)[0] > -1e-9 * np.abs(sums).max()


def test_solve_free_plate_refuses_the_mesh_of_another_plate():
    """The error names both sizes, as that of `assemble`."""
    mesh = Mesh(12, 9, LENGTH, WIDTH)
    for solve in (solve_free_plate, assemble):
        with pytest.raises(InputError, match=r"^mesh: .*0\.3148 x.*0\.3048 x"):
            solve(replace(PAPER, length=LENGTH + 0.01), mesh)


def test_receptances_equal_direct_solve(free):
    """Deflection per unit force between places and to points, a mass and a finger on the plate."""
    places = np.array([[0.0, 0.0], [0.21, 0.07], [0.11, WIDTH]])
    points = free.mesh.nodes[::5]
    loads = (PointLoad(0.2, 0.1, mass=0.02), PointLoad(0.05, 0.2, 1000.0, 2.0, 2e-4))
    frequencies = np.array([60.0, 155.0, 470.0])
    between, to_points = free.receptances(places, points, frequencies, loads=loads)
    matrices = assemble(free.plate, free.mesh)
    touch = matrices.deflection_at(places)
    carry = matrices.deflection_at(np.array([[load.x, load.y] for load in loads]))
    for row, omega in enumerate(2 * np.pi * frequencies):
        attached = [-(omega**2) * 0.02, 1000.0 + 2j * omega - omega**2 * 2e-4]
        dynamic = (1 + 0.01j) * matrices.stiffness - omega**2 * matrices.mass
        dynamic = dynamic + carry.T @ sparse.diags_array(attached) @ carry
        field = splu(dynamic.tocsc()).solve(touch.T.toarray().astype(complex))
        for quick, exact in (
            (between[row], touch @ field),
            (to_points[row], (matrices.deflection_at(points) @ field).T),
        ):
            assert np.linalg.norm(quick - exact) < 2e-6 * np.linalg.norm(exact)


@pytest.mark.parametrize("kind", ["elements", "polynomials", "layers"])
def test_shapes_at_footprints_are_not_those_of_points_of_the_same_bytes(kind):
    """Three points and two footprints of six numbers each, one after the other."""
    plate = Plate(LENGTH, WIDTH, 0.0015, ALUMINIUM)
    if kind == "layers":
        halves = LaminateLayer(ALUMINIUM, 0.0007), LaminateLayer(ALUMINIUM, 0.0008)
        plate = replace(plate, laminate=Laminate(halves))
    mesh = MESHES["4x3 Q4"] if kind == "elements" else SpectralMesh(8, 8, LENGTH, WIDTH)
    modes = solve_free_plate(plate, mesh, frequency_max=200.0).modes
    numbers = np.array([0.1, 0.05, 0.01, 0.12, 0.06, 0.012])
    for shape in ((3, 2), (2, 3)):
        assert len(modes.shapes_at(numbers.reshape(shape))) == shape[0]


def test_receptances_of_a_thicker_plate(free):
    """A thin plate h times as thick moves at w as the plate itself does at w / h, over h³.

    With loads of dynamic stiffness Z(w) / h³.
    """
    places = np.array([[0.0, 0.0, 0.01], [0.21, 0.07, 0.01], [0.11, WIDTH, 0.0]])
    points, frequencies = free.mesh.nodes[::29], np.array([61.0, 155.0, 390.0])
    loads = (PointLoad(0.2, 0.1, mass=0.02), PointLoad(0.05, 0.2, 1000.0, 2.0, 2e-4))
    h = 1.05
    scaled = [
        replace(
            load, stiffness=load.stiffness / h**3, damping=load.damping / h**2, mass=load.mass / h
        )
        for load in loads
    ]
    expected = free.receptances(places, points, frequencies / h, loads=scaled)
    found = free.receptances(places, points, frequencies, loads=loads, thickness=h)
    for ours, theirs in zip(found, expected, strict=True):
        np.testing.assert_allclose(ours, theirs / h**3, atol=1e-9 * np.abs(ours).max())
