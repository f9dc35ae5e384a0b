"""The free plate with attachments, against the direct solve of the same mesh.

The reduced plate, its slopes and its modes, against the full one; a part whose mass does not follow
the thickness; modes that differ from the theory, and a loss factor that varies, in every solution.
"""

import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
import pytest
from scipy import sparse
from scipy.sparse.linalg import splu

from cases import shortly
from kit.direct_plate import direct_responder
from kit.plates import ALUMINIUM, LENGTH, WIDTH, make_paper_rig
from model.arrays import ComplexArray, FloatArray
from model.errors import InputError
from model.estimate.forward import ForwardModel, Sensor
from model.estimate.rig_parameters import space_of
from model.estimate.sensed_plate import sensed_plate
from model.fem import ELEMENTS, MITC4, Mesh, PlateMatrices, assemble
from model.finger import Grid
from model.reduction import element_modes
from model.reduction.attachment_points import place_slopes
from model.reduction.free_plate import FreePlate, solve_free_plate
from model.rig.rig import Rig, Uncertainty
from model.rig.rig_file import example_rig_path, load_rig
from model.spectral.plate_mesh import SpectralMesh
from model.structure.attachments import PointLoad
from model.structure.laminate_bending import equivalent_plate
from model.structure.material import Material
from model.structure.plate import LOSS_FREQUENCY, AirGap, Laminate, LaminateLayer, Plate
from model.structure.sources import Era
from model.table.table_file import TableProblem, build_table

PAPER = Plate(LENGTH, WIDTH, 0.0015, ALUMINIUM)

# Even and odd counts of elements, low and high order, with strips along the edges and without.
MESHES = {
    "16x12": Mesh(16, 12, LENGTH, WIDTH),
    "15x11": Mesh(15, 11, LENGTH, WIDTH),
    "4x3 Q4": Mesh(4, 3, LENGTH, WIDTH, ELEMENTS["Q4"], 0.003),
}


def assert_within(response: ComplexArray, expected: ComplexArray, tolerance: float) -> None:
    """Compare responses of each ERA at each frequency, relative in the norm over the points."""
    differences = np.linalg.norm(response - expected, axis=2)
    errors = differences / np.linalg.norm(expected, axis=2)
    np.testing.assert_allclose(errors, 0, atol=tolerance, err_msg="by frequency and ERA")


@pytest.fixture(scope="module", params=MESHES)
def free(request: pytest.FixtureRequest) -> FreePlate:
    """The paper's plate, solved once for all layouts."""
    return solve_free_plate(PAPER, MESHES[request.param])


# Responses with attachments


@dataclass(frozen=True)
class Case:
    """A plate on a mesh with ERAs and loads, and the relative error (L2) of its response."""

    plate: Plate
    mesh: Mesh | SpectralMesh
    eras: Sequence[Era]
    loads: tuple[PointLoad, ...] = ()
    tolerance: float = 1e-4


def elements(plate: Plate, nx: int, ny: int, kind: str | None = None) -> Mesh:
    """A mesh of finite elements on this plate."""
    kinds = [ELEMENTS[kind]] if kind else []
    return Mesh(nx, ny, plate.length, plate.width, *kinds)


def polynomials(plate: Plate, nx: int, ny: int) -> SpectralMesh:
    """A mesh of polynomials on this plate."""
    return SpectralMesh(nx, ny, plate.length, plate.width)


def eras_at(
    plate: Plate, *shares: tuple[float, float], foot: float = 0.0, stiffness: float = 17e3
) -> list[Era]:
    """ERAs at positions in shares of the plate's sides."""
    positions = np.array(shares) * (plate.length, plate.width)
    return [
        Era(f"E{number}", x, y, stiffness, 3.5, 0.0, 1e-4, foot=foot)
        for number, (x, y) in enumerate(positions.tolist())
    ]


PANE = Plate(0.375, 0.225, 2.5e-3, Material("glass", 70e9, 2500.0, 0.2), loss_factor=0.02)
ADHESIVE = LaminateLayer(Material("adhesive", 1e6, 1000.0, 0.49), 0.2e-3)
ROWS = ((10.0, 0.5, 0.3), (100.0, 1.0, 0.4), (1000.0, 2.0, 0.5))


def panel(**core: Any) -> Plate:
    """Glass on glass by an adhesive with these losses."""
    cover = LaminateLayer(Material("cover", 71.5e9, 2420.0, 0.21), 1.8e-3)
    layers = (cover, replace(ADHESIVE, **core), LaminateLayer(PANE.material, 0.7e-3))
    return equivalent_plate(
        Laminate(layers), length=0.375, width=0.225, frequency=500.0, loss_factor=0.01
    )


CORNERS = ((0, 0), (1, 0), (0, 1), (1, 1))
WITHIN = ((0.21, 0.3), (0.63, 0.11), (0.47, 0.83), (0.9, 0.6))
TOGETHER = ((0.21, 0.3), (0.63, 0.11), (0.64, 0.11), (0.9, 0.6))
MASS = PointLoad(0.1, 0.1, mass=0.02, foot=0.01)
SPRING = PointLoad(0.1, 0.05, 2e3, 1.0, 0.01)

UNDAMPED = replace(PAPER, loss_factor=0.0)
UNDAMPED_ERAS = (
    Era("A", 0.05, 0.02, 3e4, 0.0, 0.01, 1e-4),
    Era("B", 0.29, 0.08, 1e5, 0.0, 0.0, 1e-4),
    Era("C", 0.12, WIDTH, 8e3, 0.0, 0.0, 1e-4),
)
BLOCK = Plate(0.3, 0.2, 0.02, ALUMINIUM)
BAR = Plate(1.0, 0.02, 0.002, ALUMINIUM)
TINY = Plate(0.03, 0.03, 0.002, ALUMINIUM)
OPEN_AIR = replace(PANE, air_gap=AirGap(5e-3))
SEALED_AIR = replace(PANE, air_gap=AirGap(5e-3, closed=True))
LOSSY = replace(PAPER, loss_exponent=0.4)
TWO_SHARES = ((0.3, 1.0), (0.0, 0.0))

CASES = {
    "undamped": Case(UNDAMPED, elements(UNDAMPED, 24, 18), UNDAMPED_ERAS),
    "block that only rocks": Case(BLOCK, elements(BLOCK, 3, 3, "Q4"), eras_at(BLOCK, *WITHIN)),
    "bar": Case(BAR, elements(BAR, 60, 3), eras_at(BAR, *TWO_SHARES)),
    "one element": Case(TINY, elements(TINY, 1, 1), eras_at(TINY, *TWO_SHARES)),
    "feet": Case(PAPER, elements(PAPER, 24, 18), eras_at(PAPER, *CORNERS, foot=0.006), (MASS,)),
    "loss that rises with frequency": Case(
        LOSSY, polynomials(LOSSY, 13, 11), eras_at(LOSSY, *WITHIN)
    ),
    "open air": Case(OPEN_AIR, polynomials(PANE, 10, 8), eras_at(PANE, *CORNERS), tolerance=0.01),
    "sealed air": Case(
        SEALED_AIR, polynomials(PANE, 10, 8), eras_at(PANE, *CORNERS), tolerance=0.01
    ),
}
for layout, shares in {"corners": CORNERS, "within": WITHIN, "together": TOGETHER}.items():
    for foot in (0.0, 0.004):
        eras = eras_at(PAPER, *shares, foot=foot)
        case = Case(PAPER, polynomials(PAPER, 12, 9), eras, (SPRING,), 1e-5)
        CASES[f"{layout}, foot of {1e3 * foot:g} mm"] = case
for name, plate, tolerance in (
    ("layers", panel(), 1e-3),
    ("lossy layers", panel(loss_factor=0.3), 0.01),
    ("layers by frequency", panel(by_frequency=ROWS), 0.02),
):
    mesh, eras = polynomials(plate, 18, 12), eras_at(plate, *CORNERS)
    CASES[name] = Case(plate, mesh, eras, tolerance=tolerance)
SHORT = set(CASES) - {"layers", "lossy layers"}


@pytest.mark.parametrize("name", shortly(CASES, SHORT))
def test_modes_respond_as_the_direct_solution(name):
    """All unknowns at each frequency: extreme plates, feet, air, layers, losses."""
    case = CASES[name]
    frequencies = np.array([45.0, 106.4, 250.0, 480.0])
    sides = (case.plate.length, case.plate.width)
    points = np.random.default_rng(1).uniform(0.01, 0.99, (25, 2)) * sides

    free = solve_free_plate(case.plate, case.mesh, frequency_max=500.0)
    response = free.acceleration(case.eras, frequencies, points, loads=case.loads)

    direct = direct_responder(case.plate, case.mesh)
    expected = direct(case.eras, frequencies, points, loads=case.loads)
    assert_within(response, expected, case.tolerance)


@pytest.mark.parametrize(
    ("frequency", "x", "mesh", "message"),
    [
        (0.0, 0.1, (12, 9), "^frequency must be"),
        (float("nan"), 0.1, (12, 9), "^frequency must be"),
        (501.0, 0.1, (12, 9), "^frequency must be"),
        # The wave at 450 Hz is 180 mm, an element 51 mm, a strip 40 mm; six nodes to a wavelength
        # are needed.
        (450.0, 0.1, (6, 5), "resolves, got 450 Hz"),
        (450.0, 0.1, (12, 9, MITC4, 0.04), "resolves, got 450 Hz"),
        (100.0, LENGTH + 0.01, (12, 9), "must be on the plate"),
        (100.0, -0.01, (12, 9), "must be on the plate"),
    ],
)
def test_acceleration_rejects_values_out_of_range(frequency, x, mesh, message):
    """Frequencies not solved for or too high for the mesh; ERAs and points off the plate."""
    nx, ny, *kind = mesh
    free = solve_free_plate(PAPER, Mesh(nx, ny, LENGTH, WIDTH, *kind))
    eras = eras_at(PAPER, *CORNERS)
    misplaced_era = replace(eras[0], x=x)
    frequencies = np.array([100.0, frequency])

    with pytest.raises(InputError, match=message):
        free.acceleration(eras, frequencies, np.array([[x, 0.1]]))
    with pytest.raises(InputError, match=message):
        free.acceleration([misplaced_era], frequencies, free.mesh.nodes)


@pytest.mark.parametrize("solve", [solve_free_plate, assemble])
def test_mesh_of_another_plate_is_rejected_with_both_sizes(solve):
    """A mesh belongs to the sides of one plate."""
    longer = replace(PAPER, length=LENGTH + 0.01)

    with pytest.raises(InputError, match=r"^mesh: .*0\.3148 x.*0\.3048 x"):
        solve(longer, MESHES["16x12"])


def test_receptances_equal_direct_solve(free):
    """Deflection per unit force between places and to points, a mass and a finger on the plate."""
    places = np.array([[0.0, 0.0], [0.21, 0.07], [0.11, WIDTH]])
    points = free.mesh.nodes[::5]
    loads = (PointLoad(0.2, 0.1, mass=0.02), PointLoad(0.05, 0.2, 1000.0, 2.0, 2e-4))
    frequencies = np.array([60.0, 155.0, 470.0])

    between, to_points = free.receptances(places, points, frequencies, loads=loads)

    matrices = assemble(free.plate, free.mesh)
    at_places, at_points = matrices.deflection_at(places), matrices.deflection_at(points)
    at_loads = matrices.deflection_at(np.array([[load.x, load.y] for load in loads]))
    forces = at_places.T.toarray().astype(complex)
    expected_between, expected_to_points = [], []
    for omega in 2 * np.pi * frequencies:
        mass_stiffness = -(omega**2) * 0.02
        finger_stiffness = 1000.0 + 2j * omega - omega**2 * 2e-4
        attached = sparse.diags_array([mass_stiffness, finger_stiffness])
        dynamic = (1 + 0.01j) * matrices.stiffness - omega**2 * matrices.mass
        dynamic = dynamic + at_loads.T @ attached @ at_loads
        deflections = splu(dynamic.tocsc()).solve(forces)
        expected_between.append(at_places @ deflections)
        expected_to_points.append((at_points @ deflections).T)
    assert_within(between, np.array(expected_between), 5e-6)
    assert_within(to_points, np.array(expected_to_points), 5e-6)


@pytest.mark.parametrize("thickness", [0.4, np.array([1.0, 0.4]), np.nan])
def test_receptances_reject_a_plate_whose_truncated_modes_resonate(free, thickness):
    """At half the thickness, the first mode that is not kept falls from above 1000 to above 500 Hz.

    At 0.4 times the thickness, it falls below 500 Hz.
    """
    places, frequencies = np.array([[0.1, 0.1]]), np.array([500.0])

    with pytest.raises(InputError, match=r"^thickness must be above 0\.4.* got (0\.4|nan);"):
        free.receptances(places, places, frequencies, thickness=thickness)
    assert free.receptances(places, places, frequencies, thickness=0.5)


def test_threads_share_the_shapes_at_points():
    """Eight threads at more sets of points than are cached get the results of one thread."""
    modes = solve_free_plate(PAPER, SpectralMesh(6, 6, LENGTH, WIDTH), frequency_max=100.0).modes
    places = [np.array([[0.01 * number, 0.1]]) for number in range(12)]
    expected = [modes.shapes_at(place) for place in places]

    def compare_from(first: int) -> None:
        for number in range(first, first + 150):
            shapes = modes.shapes_at(places[number % 12])
            np.testing.assert_array_equal(shapes, expected[number % 12])

    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        with ThreadPoolExecutor(8) as pool:
            list(pool.map(compare_from, range(8)))
    finally:
        sys.setswitchinterval(interval)


# The reduced plate


def test_slopes_are_those_of_waves() -> None:
    """Inside, near edges and at corners, to 2e-6 of the wave number, from points on the plate."""
    sides = np.array([0.3, 0.2])
    wave_vectors = np.array([[20.0, 0.0], [35.0, -60.0], [0.0, 90.0]])  # rad/m
    positions = np.array([[0.1, 0.05], [0.0, 0.12], [0.3, 0.2], [1e-7, 0.2], [0.12, 0.2 - 1e-7]])
    discs = np.column_stack([positions, np.full(len(positions), 0.01)])

    def field(points: FloatArray) -> FloatArray:
        assert (points[:, :2] >= 0).all()
        assert (points[:, :2] <= sides).all()
        assert (points[:, 2] == 0.01).all()
        return np.asarray(np.sin(points[:, :2] @ wave_vectors.T))

    slopes = place_slopes(field, discs, sides)

    phases = np.cos(positions @ wave_vectors.T)
    np.testing.assert_allclose(slopes, phases[:, None] * wave_vectors.T, atol=2e-6 * 90)


# A mass that does not follow the thickness


@dataclass(frozen=True)
class Framed(Plate):
    """A plate with a mass [kg] along its edges, on the nodes of a mesh there."""

    frame_mass: float = 0.0


def assemble_framed(plate: Plate, mesh: Mesh) -> PlateMatrices:
    """The plate's matrices, with its frame."""
    matrices = assemble(plate, mesh)
    if not isinstance(plate, Framed):
        return matrices
    sides = [plate.length, plate.width]
    is_at_edge = np.isclose(mesh.nodes, 0) | np.isclose(mesh.nodes, sides)
    nodes = np.flatnonzero(is_at_edge.any(axis=1))
    frame = np.zeros(mesh.dof)
    frame[3 * nodes] = plate.frame_mass / len(nodes)
    return replace(matrices, mass=sparse.csc_array(matrices.mass + sparse.diags_array(frame)))


def test_uncertain_thickness_is_rejected_if_a_mass_does_not_follow_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Tables of an uncertain thickness, identification and calibration count on scaling."""
    monkeypatch.setattr(element_modes, "assemble", assemble_framed)
    paper_rig = make_paper_rig(24, 18)
    values = {field.name: getattr(paper_rig.plate, field.name) for field in fields(Plate)}
    rig = replace(paper_rig, plate=Framed(**values, frame_mass=0.053))
    exact_rig = replace(rig, uncertainty=Uncertainty.none())
    free = solve_free_plate(rig.plate, rig.mesh)
    frequencies, sensors = np.array([60.0, 80.0]), [Sensor("SW", era="SW")]
    space = space_of(rig, ["SW"], rig.uncertainty)
    exact_space = space_of(exact_rig, ["SW"], exact_rig.uncertainty)

    table = build_table(exact_rig, frequencies=frequencies)
    with pytest.raises(InputError, match=r"plate\.frame_mass.*set uncertainty"):
        TableProblem(rig, frequencies, Grid(2, 2))
    with pytest.raises(InputError, match=r"plate\.frame_mass.*set uncertainty"):
        _ = replace(table, uncertainty=rig.uncertainty).attached
    with pytest.raises(InputError, match=r"plate\.frame_mass.*era rig identify"):
        ForwardModel(rig, sensors, frequencies, space, free)
    with pytest.raises(InputError, match=r"plate\.frame_mass.*era rig identify"):
        sensed_plate(exact_rig, sensors, frequencies)
    assert ForwardModel(exact_rig, sensors, frequencies, exact_space, free)


# Modes that differ from the theory

FREQUENCIES = np.array([65.0, 150.0, 240.0, 430.0])
DEVIATIONS = ((0.02, 0.3), (0.0, 0.0), (-0.03, -0.4))
POINTS = np.array([[0.05, 0.04], [0.2, 0.11]])


@pytest.fixture(scope="module")
def deviating_rig() -> Rig:
    """The paper's plate with two modes off its theory, and a loss that rises with frequency."""
    rig = load_rig(example_rig_path())
    plate = replace(rig.plate, loss_exponent=0.4, mode_deviations=DEVIATIONS)
    return replace(rig, plate=plate)


@pytest.fixture(scope="module")
def nominal_rig(deviating_rig: Rig) -> Rig:
    """The same plate with the modes of the theory."""
    return replace(deviating_rig, plate=replace(deviating_rig.plate, mode_deviations=()))


def test_deviations_change_the_receptance_of_their_modes_alone(
    deviating_rig: Rig, nominal_rig: Rig
) -> None:
    """The receptance changes by that of three oscillators with stiffness and loss of their own."""
    plate, mesh = deviating_rig.plate, deviating_rig.mesh
    free = solve_free_plate(plate, mesh, frequency_max=500.0)
    nominal_free = solve_free_plate(nominal_rig.plate, mesh, frequency_max=500.0)

    receptances, _ = free.receptances(POINTS, POINTS, FREQUENCIES)
    expected, _ = nominal_free.receptances(POINTS, POINTS, FREQUENCIES)

    omega = 2 * np.pi * FREQUENCIES
    loss_factors = plate.loss_factor * (FREQUENCIES / LOSS_FREQUENCY) ** 0.4
    shapes = free.modes.shapes_at(POINTS)
    elastic_modes = np.argsort(free.modes.eigenvalues)[3:6]
    for mode, (shift, loss) in zip(elastic_modes, DEVIATIONS, strict=True):
        eigenvalue = free.modes.eigenvalues[mode]
        own_losses = loss_factors * np.exp(loss)
        own_stiffness = eigenvalue * np.exp(shift) * (1 + 1j * own_losses)
        nominal_stiffness = eigenvalue * (1 + 1j * loss_factors)
        own_receptance = 1 / (own_stiffness - omega**2)
        change = own_receptance - 1 / (nominal_stiffness - omega**2)
        shape = shapes[:, mode]
        expected += change[:, None, None] * np.outer(shape, shape)
    np.testing.assert_allclose(receptances, expected, atol=1e-12 * np.abs(expected).max())
