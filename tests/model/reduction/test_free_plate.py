"""The free plate with attachments, against the direct solve of the same mesh.

The reduced plate, its slopes and its modes, against the full one; a part whose mass does not follow
the thickness; modes that differ from the theory, and a loss factor that varies, in every solution.
"""

import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
import pytest
from scipy import sparse
from scipy.sparse.linalg import splu

from cases import shortly
from kit.direct_plate import direct_acceleration, direct_responder
from kit.plates import ALUMINIUM, LENGTH, WIDTH, make_paper_rig
from model.arrays import FloatArray
from model.errors import InputError
from model.estimate.forward import ForwardModel, Sensor
from model.estimate.rig_parameters import space_of
from model.estimate.sensed_plate import sensed_plate
from model.fem import ELEMENTS, MITC4, Mesh, PlateMatrices, assemble
from model.finger import Grid
from model.reduction import free_plate
from model.reduction.attachment_points import place_slopes
from model.reduction.free_plate import (
    FreePlate,
    solve_free_plate,
)
from model.reduction.reduced_plate import reduce_plate
from model.reduction.supported_plate import modal_matrices
from model.rig.rig import Rig, Uncertainty
from model.rig.rig_file import example_rig_path, load_rig
from model.spectral.plate_mesh import SpectralMesh
from model.structure.attachments import PointLoad, footprints_of
from model.structure.material import Material
from model.structure.plate import (
    LOSS_FREQUENCY,
    AirGap,
    Laminate,
    LaminateLayer,
    Plate,
    equivalent_plate,
)
from model.structure.sources import Era
from model.study.verification import verify_table
from model.table.table_file import TableProblem, build_table
from model.vibration import natural_modes

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


def eras_at(*places: tuple[float, float], foot: float = 0.0) -> list[Era]:
    """ERAs at places in shares of the sides."""
    return [Era(f"E{n}", *at, 17e3, 3.5, 0.0, 1e-4, foot=foot) for n, at in enumerate(places)]


BAR = (Era("A", 0.3, 1.0, 1e4, 1.0, 0.0, 1e-4), Era("B", 0.0, 0.0, 1e4, 1.0, 0.0, 1e-4))
SPREAD = (
    Era("A", 0.16, 0.09, 3e4, 0.0, 0.01, 1e-4),
    Era("B", 0.95, 0.35, 1e5, 0.0, 0.0, 1e-4),
    Era("C", 0.39, 1.0, 8e3, 0.0, 0.0, 1e-4),
)
AT_CORNERS = ((0, 0), (1, 0), (0, 1), (1, 1))
WITHIN = ((0.21, 0.3), (0.63, 0.11), (0.47, 0.83), (0.9, 0.6))
TOGETHER = ((0.21, 0.3), (0.63, 0.11), (0.64, 0.11), (0.9, 0.6))
MASS, SPRING = PointLoad(0.1, 0.1, mass=0.02, foot=0.01), PointLoad(0.1, 0.05, 2e3, 1.0, 0.01)
BY_DEGREES = "polynomials"
TWO_WAYS = {
    # no damping to hide behind
    "undamped": (replace(PAPER, loss_factor=0.0), (24, 18), SPREAD, (), 1e-4),
    # only rocks up to 500 Hz
    "block": (Plate(0.3, 0.2, 0.02, ALUMINIUM), (3, 3, "Q4"), SPREAD, (), 1e-4),
    # many modes in a row
    "bar": (Plate(1.0, 0.02, 0.002, ALUMINIUM), (60, 3), BAR, (), 1e-4),
    "standing bar": (Plate(0.05, 0.4, 0.002, ALUMINIUM), (4, 40), BAR, (), 1e-4),
    # hardly any degrees of freedom
    "one element": (Plate(0.03, 0.03, 0.002, ALUMINIUM), (1, 1), BAR, (), 1e-4),
    "two elements": (Plate(0.03, 0.03, 0.002, ALUMINIUM), (2, 1), BAR, (), 1e-4),
    "feet": (PAPER, (24, 18), eras_at(*AT_CORNERS, foot=0.006), (MASS,), 1e-4),
    **{
        f"{name}, foot of {1e3 * foot:g} mm": (
            *(PAPER, (12, 9, BY_DEGREES), eras_at(*places, foot=foot), (SPRING,), 1e-5),
        )
        for name, places in {"corners": AT_CORNERS, "within": WITHIN, "together": TOGETHER}.items()
        for foot in (0.0, 0.004)
    },
    "loss that rises with frequency": (
        *(replace(PAPER, loss_exponent=0.4), (13, 11, BY_DEGREES), eras_at(*WITHIN), (), 1e-4),
    ),
    **{
        f"air, {closed=}": (
            *(replace(PANE, air_gap=AirGap(5e-3, closed=closed)), (10, 8, BY_DEGREES)),
            *(eras_at(*AT_CORNERS), (), 0.01),
        )
        for closed in (False, True)
    },
    "layers": (panel(), (18, 12, BY_DEGREES), eras_at(*AT_CORNERS), (), 1e-3),
    "lossy layers": (
        *(panel(loss_factor=0.3), (18, 12, BY_DEGREES), eras_at(*AT_CORNERS), (), 0.01),
    ),
    "layers by frequency": (
        *(panel(by_frequency=ROWS), (18, 12, BY_DEGREES), eras_at(*AT_CORNERS), (), 0.02),
    ),
}
"""By name: a plate, its mesh, ERAs in shares of the sides, loads, and the relative error (L2)."""


@pytest.mark.parametrize(
    "name", shortly(TWO_WAYS, [name for name in TWO_WAYS if name not in ("layers", "lossy layers")])
)
def test_modes_and_truncated_ones_respond_as_the_direct_solution(name):
    """Of all unknowns at each frequency: extreme plates, feet, air, layers, losses."""
    plate, (nx, ny, *kind), eras, loads, tolerance = TWO_WAYS[name]
    sides = np.array([plate.length, plate.width])
    elements = [ELEMENTS[each] for each in kind if each != BY_DEGREES]
    mesh = (SpectralMesh if BY_DEGREES in kind else Mesh)(nx, ny, *sides, *elements)
    eras = tuple(replace(era, x=era.x * sides[0], y=era.y * sides[1]) for era in eras)
    frequencies = np.array([45.0, 106.4, 250.0, 480.0])
    points = np.random.default_rng(1).uniform(0.01, 0.99, (25, 2)) * sides
    free = solve_free_plate(plate, mesh, frequency_max=500.0)
    quick = free.acceleration(eras, frequencies, points, loads=loads)
    direct = direct_responder(plate, mesh)(eras, frequencies, points, loads=loads)
    error = np.linalg.norm(quick - direct, axis=2) / np.linalg.norm(direct, axis=2)
    assert error.max() < tolerance


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
def test_acceleration_refuses_values_out_of_range(frequency, x, mesh, message):
    """Frequencies not solved for or too high for the mesh; ERAs and points off the plate.

    The mesh of another plate is refused with both sizes.
    """
    free = solve_free_plate(PAPER, Mesh(*mesh[:2], LENGTH, WIDTH, *mesh[2:]))
    eras, frequencies = random_eras(np.random.default_rng(0), 3), np.array([100.0, frequency])
    with pytest.raises(InputError, match=message):
        free.acceleration(eras, frequencies, np.array([[x, 0.1]]))
    with pytest.raises(InputError, match=message):
        free.acceleration((replace(eras[0], x=x),), frequencies, free.mesh.nodes)
    for solve in (solve_free_plate, assemble):
        with pytest.raises(InputError, match=r"^mesh: .*0\.3148 x.*0\.3048 x"):
            solve(replace(PAPER, length=LENGTH + 0.01), free.mesh)


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


@pytest.mark.parametrize("thickness", [0.4, np.array([1.0, 0.4]), np.nan])
def test_receptances_refuse_a_plate_whose_truncated_modes_resonate(free, thickness):
    """At half the thickness, the first mode that is not kept falls from above 1000 to above 500 Hz.

    At 0.4 times the thickness, it falls below 500 Hz.
    """
    places = np.array([[0.1, 0.1]])
    with pytest.raises(InputError, match=r"^thickness must be above 0\.4.* got (0\.4|nan);"):
        free.receptances(places, places, np.array([500.0]), thickness=thickness)
    assert free.receptances(places, places, np.array([500.0]), thickness=0.5)


def test_threads_share_the_shapes_at_points():
    """Eight threads at more sets of points than are kept obtain what one thread obtains."""
    modes = solve_free_plate(PAPER, SpectralMesh(6, 6, LENGTH, WIDTH), frequency_max=100.0).modes
    places = [np.array([[0.01 * number, 0.1]]) for number in range(12)]
    alone = [modes.shapes_at(place) for place in places]

    def visit(first: int) -> None:
        for number in range(first, first + 150):
            shapes = modes.shapes_at(places[number % 12])
            np.testing.assert_array_equal(shapes, alone[number % 12])

    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        with ThreadPoolExecutor(8) as pool:
            list(pool.map(visit, range(8)))
    finally:
        sys.setswitchinterval(interval)


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
    reduced = reduce_plate(PAPER, MESH, footprints_of(eras))
    touch, observe = reduced.at(footprints_of(eras)), reduced.at(MESH.nodes)
    direct = direct_acceleration(assemble(PAPER, MESH), eras, frequencies, MESH.nodes)
    for row, omega in enumerate(2 * np.pi * frequencies):
        spring = np.array([era.stiffness + 1j * omega * era.damping for era in eras])
        attached = spring - omega**2 * np.array([era.bolt_mass for era in eras])
        dynamic = np.diag((1 + 0.01j) * reduced.omega**2 - omega**2) + (touch.T * attached) @ touch
        answer = -(omega**2) * observe @ np.linalg.solve(dynamic, touch.T * spring * 1e-4)
        error = np.linalg.norm(answer.T - direct[row], axis=1)
        error /= np.linalg.norm(direct[row], axis=1)
        assert error.max() < 3e-5


SIDES = np.array([0.3, 0.2])
WAVES = np.array([[20.0, 0.0], [35.0, -60.0], [0.0, 90.0]])  # rad/m


def test_projection_needs_the_origin_of_both_reductions() -> None:
    """Between a reduction and one of which only coordinates are known, none is guessed."""
    known = reduce_plate(PAPER, MESH, np.array(CORNERS))
    unknown = replace(known, origin=None)
    for own, other in ((known, unknown), (unknown, known)):
        with pytest.raises(ValueError, match="only the coordinates of one"):
            own.projection_from(other)
    np.testing.assert_allclose(known.projection_from(known), np.eye(len(known.omega)), atol=1e-6)


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


FRAME = 0.053  # kg
FREQUENCIES = np.arange(60.0, 301.0, 20.0)
POINTS = np.array([[0.08, 0.06], [0.2, 0.15]])


@dataclass(frozen=True)
class Framed(Plate):
    """A plate with a mass [kg] along its edges, on the nodes of a mesh there."""

    frame_mass: float = 0.0


def assemble_framed(plate: Plate, mesh: Mesh) -> PlateMatrices:
    """The plate's matrices, with its frame."""
    found = assemble(plate, mesh)
    if not isinstance(plate, Framed):
        return found
    at_edge = np.isclose(mesh.nodes, 0) | np.isclose(mesh.nodes, [plate.length, plate.width])
    nodes = np.flatnonzero(at_edge.any(axis=1))
    frame = np.zeros(mesh.dof)
    frame[3 * nodes] = plate.frame_mass / len(nodes)
    return replace(found, mass=sparse.csc_array(found.mass + sparse.diags_array(frame)))


@pytest.fixture
def rig(monkeypatch: pytest.MonkeyPatch) -> Rig:
    """The paper's rig with a frame, in finite elements."""
    monkeypatch.setattr(free_plate, "assemble", assemble_framed)
    plain = make_paper_rig(24, 18)
    own = {each.name: getattr(plain.plate, each.name) for each in fields(plain.plate)}
    return replace(plain, plate=Framed(**own, frame_mass=FRAME))


def receptance(free: FreePlate, rig: Rig, thickness: float = 1.0) -> FloatArray:
    """Sizes of the response at POINTS to forces at the ERAs, on their springs."""
    places = np.array([(era.x, era.y) for era in rig.eras])
    loads = [PointLoad(era.x, era.y, stiffness=era.stiffness) for era in rig.eras]
    _, found = free.receptances(places, POINTS, FREQUENCIES, loads=loads, thickness=thickness)
    return np.abs(found)


def test_all_that_counts_on_scaling_refuses_a_frame(rig: Rig) -> None:
    """Tables of an uncertain thickness, identification, calibration."""
    with pytest.raises(InputError, match=r"plate\.frame_mass.*set uncertainty"):
        TableProblem(rig, FREQUENCIES, Grid(2, 2))
    known = replace(rig, uncertainty=Uncertainty.none())
    table = build_table(known, frequencies=FREQUENCIES[:2])
    with pytest.raises(InputError, match=r"plate\.frame_mass.*set uncertainty"):
        _ = replace(table, uncertainty=rig.uncertainty).attached
    free = solve_free_plate(rig.plate, rig.mesh)
    sensors = [Sensor("SW", era="SW")]
    space = space_of(rig, ["SW"], rig.uncertainty)
    with pytest.raises(InputError, match=r"plate\.frame_mass.*era rig identify"):
        ForwardModel(rig, sensors, FREQUENCIES, space, free)
    with pytest.raises(InputError, match=r"plate\.frame_mass.*era rig identify"):
        sensed_plate(known, sensors, FREQUENCIES)
    assert ForwardModel(
        known, sensors, FREQUENCIES, space_of(known, ["SW"], known.uncertainty), free
    )


DEVIATING_HZ = np.array([65.0, 150.0, 240.0, 430.0])
DEVIATIONS = ((0.02, 0.3), (0.0, 0.0), (-0.03, -0.4))
DEVIATING_POINTS = np.array([[0.05, 0.04], [0.2, 0.11]])


@pytest.fixture(scope="module")
def deviating_rig() -> Rig:
    """The paper's plate with three modes off its theory, and a loss that rises with frequency."""
    rig = load_rig(example_rig_path())
    plate = replace(rig.plate, loss_exponent=0.4, mode_deviations=DEVIATIONS)
    return replace(rig, plate=plate)


def test_only_the_modes_named_change_the_receptance(deviating_rig: Rig) -> None:
    """The receptance changes by that of three oscillators with stiffness and loss of their own."""
    plain = replace(deviating_rig, plate=replace(deviating_rig.plate, mode_deviations=()))
    solved = [
        solve_free_plate(each.plate, each.mesh, frequency_max=500.0)
        for each in (deviating_rig, plain)
    ]
    found, before = (
        free.receptances(DEVIATING_POINTS, DEVIATING_POINTS, DEVIATING_HZ)[0] for free in solved
    )
    modes = solved[0].modes
    elastic = np.sort(modes.eigenvalues)[3:6]
    omega = 2 * np.pi * DEVIATING_HZ
    eta = deviating_rig.plate.loss_factor * (DEVIATING_HZ / LOSS_FREQUENCY) ** 0.4
    expected = before.copy()
    for eigenvalue, (shift, loss) in zip(elastic, DEVIATIONS, strict=True):
        phi = modes.shapes_at(DEVIATING_POINTS)[
            :, np.flatnonzero(modes.eigenvalues == eigenvalue)[0]
        ]
        for factor, more, sign in ((np.exp(shift), np.exp(loss), 1), (1.0, 1.0, -1)):
            oscillator = 1 / ((1 + 1j * eta * more) * eigenvalue * factor - omega**2)
            expected += sign * oscillator[:, None, None] * np.outer(phi, phi)
    np.testing.assert_allclose(found, expected, atol=1e-12 * np.abs(expected).max())


def test_a_table_is_verified_with_them(deviating_rig: Rig) -> None:
    """Fields and answers are those of the plate with its deviations, not of the theory."""
    table = build_table(deviating_rig)
    assert verify_table(table, deviating_rig, samples=4).failed_count == 0
    other = replace(deviating_rig, plate=replace(deviating_rig.plate, mode_deviations=()))
    assert not any(each.is_passed for each in verify_table(table, other, samples=1).content)


def test_plate_in_time_has_them(deviating_rig: Rig) -> None:
    """Steady vibration of the viscous plate in time is that of the hysteretic one within 1 %."""
    reduced = reduce_plate(
        deviating_rig.plate, deviating_rig.mesh, footprints_of(deviating_rig.eras)
    )
    M, C, K = modal_matrices(reduced, deviating_rig.eras)
    free = solve_free_plate(deviating_rig.plate, deviating_rig.mesh, frequency_max=500.0)
    expected = free.acceleration(deviating_rig.eras, DEVIATING_HZ, DEVIATING_POINTS)[:, 0]
    era = deviating_rig.eras[0]
    forces = reduced.at(footprints_of(deviating_rig.eras[:1]))[0]
    for row, omega in enumerate(2 * np.pi * DEVIATING_HZ):
        base = (era.stiffness + 1j * omega * era.damping) * era.stroke
        moved = np.linalg.solve(K + 1j * omega * C - omega**2 * M, forces * base)
        found = -(omega**2) * (reduced.at(DEVIATING_POINTS) @ moved)
        error = np.linalg.norm(found - expected[row]) / np.linalg.norm(expected[row])
        assert error < 0.01
