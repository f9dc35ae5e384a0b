"""Attachments of a plate: supports, loads at points, fingertips, frames and feet.

Also boards with a grain, and the areas on which loads act.
"""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from benchmarks.direct_plate import direct_responder
from model.arrays import FloatArray
from model.errors import InputError
from model.fem import ELEMENTS, Mesh
from model.finger import Grid
from model.reduction.free_plate import solve_free_plate
from model.reduction.reduced_plate import reduce_free_plate, supported_modes
from model.rig.rig import Rig
from model.rig.rig_writing import rig as rig_by_keys
from model.structure.attachments import (
    GRAVITY,
    Era,
    Fingertip,
    PointLoad,
    check_supported,
    footprints_of,
    mean_over,
    rigid_body_frequencies,
    static_loads,
    support_problem,
)
from model.structure.material import Material, known_material
from model.structure.plate import Plate
from model.table.table import LocalizationTable
from model.table.table_file import TableProblem, solve_table, table_following
from model.vibration import natural_modes
from plates import ALUMINIUM, LENGTH, WIDTH, make_paper_rig

PLATE = Plate(0.3, 0.2, 0.002, Material("aluminium", E=70e9, rho=2700.0, nu=0.33))


def era(name: str, x: float, y: float, stiffness: float = 17e3, bolt_mass: float = 0.0) -> Era:
    """An ERA at x, y [m]."""
    return Era(name, x, y, stiffness, damping=1.0, bolt_mass=bolt_mass, stroke=1e-4)


CORNERS = [era("SW", 0, 0), era("SE", 0.3, 0), era("NE", 0.3, 0.2), era("NW", 0, 0.2)]


@pytest.mark.parametrize(
    ("loads", "slower"), [([], 1.0), ([PointLoad(0.15, 0.1, mass=PLATE.mass)], math.sqrt(2))]
)
def test_rigid_body_frequencies_are_those_of_the_textbook(
    loads: list[PointLoad], slower: float
) -> None:
    """Heave sqrt(4k/m); each tilt of four corner springs sqrt(12 k/m).

    A mass of the plate's own at its centre slows the heave alone, by sqrt(2).
    """
    heave = math.sqrt(4 * 17e3 / PLATE.mass) / (2 * math.pi)
    expected = [heave / slower, math.sqrt(3) * heave, math.sqrt(3) * heave]
    found = rigid_body_frequencies(PLATE, CORNERS, loads=loads)
    assert found == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize(
    "eras",
    [
        [],
        CORNERS[:1],
        CORNERS[:2],
        [era("a", 0, 0), era("b", 0.15, 0.1), era("c", 0.3, 0.2)],  # in one line
        [era("a", 0, 0), era("b", 0.15, 0.1001), era("c", 0.3, 0.2)],  # nearly so
        [replace(each, stiffness=0.1) for each in CORNERS],
    ],
)
def test_plate_is_not_supported_when_a_rigid_body_mode_is_free(eras: list[Era]) -> None:
    """Fewer than three springs, all in one line, or too soft."""
    assert support_problem(PLATE, eras) is not None
    with pytest.raises(InputError, match=r"supported.*; put"):
        check_supported(PLATE, eras)


@pytest.mark.parametrize(
    ("eras", "loads"),
    [(CORNERS, []), (CORNERS[:3], []), (CORNERS[:2], [PointLoad(0.15, 0.2, 17e3)])],
)
def test_plate_is_supported_by_three_springs_not_in_line(
    eras: list[Era], loads: list[PointLoad]
) -> None:
    """Corner ERAs hold heave and both tilts; springs of loads count as those of ERAs do."""
    assert support_problem(PLATE, eras, loads=loads) is None


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


HERTZ = np.array([60.0, 100.0, 250.0])


@pytest.mark.parametrize(
    ("fingertip", "hertz", "expected"),
    [
        (Fingertip(), HERTZ, [69, -87, -358]),
        (Fingertip(phalanx_mass=1e9), HERTZ, [972, 921, 507]),
        (Fingertip().scaled(2), np.zeros(1), [2000 * 500 / 2500]),
    ],
    ids=["phalanx that moves", "phalanx at rest", "twice the contact at rest"],
)
def test_dynamic_stiffness_of_a_fingertip(
    fingertip: Fingertip, hertz: FloatArray, expected: list[float]
) -> None:
    """Real parts as worked out from the formula by hand; scaled pulp and joint are in series."""
    found = fingertip.dynamic_stiffness(2 * np.pi * hertz)
    assert found.real == pytest.approx(expected, abs=1)
    assert (found.imag >= 2 * np.pi * hertz * (0.1 if fingertip.phalanx_mass < 1 else 1.999)).all()


LONG, WIDE, A = 0.3, 0.2, 0.01
# Moments of a disc of radius a about its centre, of its half and quarter beyond an edge or corner:
# mean of x - x0, and of (x - x0)². Half: 4 a / 3 pi and a² / 4.
CASES = {
    "inside": ((0.1, 0.08), (0.0, 0.0)),
    "edge": ((0.0, 0.08), (4 * A / (3 * math.pi), 0.0)),
    "corner": ((LONG, WIDE), (-4 * A / (3 * math.pi), -4 * A / (3 * math.pi))),
}


@pytest.mark.parametrize(("centre", "shift"), CASES.values(), ids=CASES)
def test_means_are_those_of_a_disc_by_hand(centre, shift):
    """Mean of x, y and of squares over what is on the plate of a disc."""
    x, y = centre

    def functions(points):
        dx, dy = points[:, 0] - x, points[:, 1] - y
        return np.column_stack([dx, dy, dx**2, dy**2])

    found = mean_over(functions, np.array([[x, y, A]]), length=LONG, width=WIDE)
    expected = [*shift, A**2 / 4, A**2 / 4]
    np.testing.assert_allclose(found[0], expected, rtol=1e-4, atol=1e-9)


def test_an_annular_wave_averages_to_the_bessel_function():
    """The mean of cos(k x) over a whole disc is 2 J1(k a) / (k a): 0.88010117 at k a = 1."""
    places = np.array([[0.1, 0.08, A], [0.2, 0.1, 0.0]])
    found = mean_over(lambda at: np.cos((at[:, :1] - 0.1) / A), places, length=LONG, width=WIDE)
    assert found[0, 0] == pytest.approx(0.88010117, rel=1e-6)
    assert found[1, 0] == pytest.approx(math.cos(0.1 / A))


@pytest.fixture(scope="module")
def on_feet():
    """The paper's rig on feet of 6 mm, with a mass on a disc."""
    rig = make_paper_rig(24, 18)
    eras = tuple(replace(era, foot=0.006) for era in rig.eras)
    return replace(rig, eras=eras, masses=(PointLoad(0.1, 0.1, mass=0.02, foot=0.01),))


def test_reduction_with_feet_equals_a_factor_for_each_frequency(on_feet):
    """Elements: the same consistent forces as the direct solution, within 1e-4."""
    frequencies = np.array([60.0, 150.0, 310.0])
    points = np.array([[0.05, 0.05], [0.2, 0.15]])
    arguments = (on_feet.eras, frequencies, points)
    free = solve_free_plate(on_feet.plate, on_feet.mesh, frequency_max=500.0)
    found = free.acceleration(*arguments, loads=on_feet.masses)
    respond = direct_responder(on_feet.plate, on_feet.mesh)
    exact = respond(*arguments, loads=on_feet.masses)
    np.testing.assert_allclose(found, exact, rtol=1e-3, atol=1e-4 * abs(exact).max())


SIDES = {"length": 0.4, "width": 0.3}
BIRCH = {"E1": 12.7e9, "E2": 4.8e9, "nu12": 0.05, "G12": 0.70e9, "G13": 0.35e9, "G23": 0.25e9}
BOARD = {**SIDES, "thickness": 6.4e-3, "material": {**BIRCH, "rho": 680.0}}
FRAME = {"frame": {"along": "edges", "mass_per_length": 0.05}}
FEET = {
    name: {"at": at, "kind": "foam"}
    for name, at in {"SW": [0.01, 0.01], "SE": [0.39, 0.01], "N": [0.2, 0.29]}.items()
}
ERA = {"A": {"at": [0.1, 0.1], "stiffness": 1e4}}

# Hz, of the free board, printed by an independent Legendre-Ritz solver with transverse shear.
BARE = [57.44, 176.41, 193.26, 210.29, 224.08, 347.98, 479.29, 506.23]
# With 0.05 kg/m along all edges, and so on boards 0.9 and 1.1 times as thick.
FRAMED = {
    1.0: [48.72, 154.25, 166.57, 175.77, 186.50, 287.67, 417.40, 420.71],
    0.9: [43.25, 137.18, 148.09, 155.91],
    1.1: [54.20, 171.32, 185.09, 195.66],
}


def board(plate: dict[str, Any] | None = None, **sections: Any) -> Rig:
    """A rig of the birch board with other keys of its plate, and further sections."""
    return rig_by_keys({**BOARD, **(plate or {})}, ERA, **sections)


def modes(rig: Rig, count: int, mesh: Mesh | None = None) -> FloatArray:
    """The lowest elastic natural frequencies [Hz] without ERAs."""
    return natural_modes(rig, count, support="free", mesh=mesh).frequencies


ELEMENTS_Q5 = Mesh(8, 6, 0.4, 0.3, ELEMENTS["Q5"], strip=0.006)


@pytest.mark.parametrize("mesh", [None, ELEMENTS_Q5], ids=["polynomials", "elements"])
def test_a_free_board_has_the_modes_of_an_independent_solver(mesh: Mesh | None) -> None:
    """Eight modes within 0.02 %; without transverse shear they would be up to 2.4 % higher."""
    np.testing.assert_allclose(modes(board(), 8, mesh), BARE, rtol=2e-4)


@pytest.mark.parametrize("thicker", FRAMED)
def test_a_frame_moves_the_modes_of_a_board_of_any_thickness(thicker: float) -> None:
    """Within 0.3 %; a frame that scaled with the board would have 43.85 Hz in place of 43.25."""
    rig = board({"thickness": thicker * 6.4e-3}, masses=FRAME)
    expected = FRAMED[thicker]
    np.testing.assert_allclose(modes(rig, len(expected)), expected, rtol=3e-3)


@pytest.mark.parametrize("thicker", [0.9, 1.1])
def test_one_solution_serves_framed_boards_of_other_thicknesses(thicker: float) -> None:
    """Resonances of plates scaled from one solution are where the independent solver has them."""
    rig = board({"loss_factor": 1e-3}, masses=FRAME)
    free = solve_free_plate(rig.plate, rig.mesh, frequency_max=500.0)
    place = np.array([[0.05, 0.03]])
    for expected in FRAMED[thicker]:
        near = expected * np.linspace(0.99, 1.01, 81)
        found, _ = free.receptances(place, place, near, loads=rig.masses, thickness=thicker)
        assert near[np.abs(found[:, 0, 0]).argmax()] == pytest.approx(expected, rel=3e-3)


def test_grain_along_the_width_is_the_board_turned() -> None:
    """A board of 0.4 x 0.3 m has the modes of one of 0.3 x 0.4 m cut the other way."""
    turned = board({"length": 0.3, "width": 0.4, "grain": "width"})
    np.testing.assert_allclose(modes(turned, 6), modes(board(), 6), rtol=1e-9)
    across = modes(board({"grain": "width"}), 6)
    assert np.abs(across / modes(board(), 6) - 1).max() > 0.05


@pytest.mark.parametrize(
    ("thickness", "moduli"),
    [(3.6e-3, (16471, 1029)), (6.4e-3, (12737, 4763)), (9.2e-3, (11395, 6105))],
)
def test_plywood_has_the_moduli_of_the_handbook(thickness: float, moduli: tuple[int, int]) -> None:
    """N/mm² of boards of 3, 5 and 7 veneers, Handbook of Finnish Plywood; nominal 6.5 mm have 5."""
    known = known_material("plywood")
    own = known.of_thickness(thickness).moduli
    assert (round(own["E1"] / 1e6), round(own["E2"] / 1e6)) == moduli
    assert known.of_thickness(6.1e-3) == known.of_thickness(6.9e-3) == known.material


def test_the_shortest_waves_of_a_board_are_those_of_its_softest_direction() -> None:
    """D1 c⁴ + 2 (nu12 D2 + 2 D12) c² s² + D2 s⁴ by hand, least over a fine fan of directions."""
    unit = 6.4e-3**3 / 12
    plane = 1 - 0.05**2 * 4.8 / 12.7
    along, across, twist = 12.7e9 * unit / plane, 4.8e9 * unit / plane, 0.7e9 * unit
    c2 = np.linspace(0, 1, 100_001)
    least = (
        along * c2**2 + 2 * (0.05 * across + 2 * twist) * c2 * (1 - c2) + across * (1 - c2) ** 2
    ).min()
    plate = board().plate
    expected = 2 * math.pi * (least / (680 * 6.4e-3 * (2 * math.pi * 500) ** 2)) ** 0.25
    assert plate.bending_wavelength(500.0) == pytest.approx(expected, rel=1e-6)
    assert plate.flexural_rigidity == pytest.approx(math.sqrt(along * across), rel=1e-9)


@pytest.mark.parametrize(
    ("name", "own"), [("plywood", 0.02), ("spruce", 0.015), ("acrylic", 0.01), ("steel", 0.01)]
)
def test_a_board_by_name_loses_what_its_wood_does(name: str, own: float) -> None:
    """A mounted panel's 1 %, or the material's own if it is more; what is stated holds."""
    assert board({"material": name}).plate.loss_factor == own
    assert board({"material": name, "loss_factor": 0.005}).plate.loss_factor == 0.005


def test_acrylic_by_name_is_stiffer_and_loses_less_at_higher_frequencies() -> None:
    """4.2, 4.6 and 5 GPa, 7.5, 6 and 4.5 % at 10, 100 and 1000 Hz, also as a layer."""
    layers = {"thickness": None, "material": None}
    layers |= {"layers": [{"material": "acrylic", "thickness": 0.005}]}
    for rig in (board({"material": "acrylic", "thickness": 0.005}), board(layers)):
        assert rig.plate.laminate is not None
        (layer,) = rig.plate.laminate.layers
        moduli = [layer.modulus(frequency) for frequency in (10.0, 100.0, 1000.0)]
        expected = [4.2e9 * (1 + 0.075j), 4.6e9 * (1 + 0.06j), 5e9 * (1 + 0.045j)]
        np.testing.assert_allclose(moduli, expected, rtol=1e-9)


def test_feet_hold_the_weight_of_board_and_frame() -> None:
    """Three feet and an ERA carry 0.522 kg of board and 70 g of frame; two feet do not hold it."""
    rig = board(masses=FRAME, supports=FEET)
    assert support_problem(rig.plate, rig.eras, loads=rig.masses) is None
    loads = static_loads(rig.plate, rig.eras, loads=rig.masses)
    weight = GRAVITY * (680 * 0.4 * 0.3 * 6.4e-3 + 1.4 * 0.05)
    assert len(loads) == 4
    assert loads.sum() == pytest.approx(weight, rel=1e-9)
    two = board(supports={"SW": FEET["SW"]})
    assert support_problem(two.plate, two.eras, loads=two.masses) is not None


def test_a_frame_that_holds_the_edges_has_its_stiffness_in_all() -> None:
    """1.4 m at 5 kN/m² are 7 kN/m, with the damper that is given for all of it."""
    tape = {"along": "edges", "stiffness_per_length": 5e3, "damping": 2.0}
    found = board(supports={"tape": tape}).masses
    assert sum(each.stiffness for each in found) == pytest.approx(7e3)
    assert sum(each.damping for each in found) == pytest.approx(2.0)
    assert {each.loss_factor for each in found} == {0.0}


def test_foam_loses_the_same_share_of_energy_in_frequency_and_in_time() -> None:
    """A rigid board on foam of loss factor eta heaves with a damping ratio of eta / 2 in time.

    And by the dynamic stiffness 4 k (1 + i eta) - omega² m in frequency.
    """
    stiff = Material("stiff", E=1e14, rho=2000.0, nu=0.3)
    plate = Plate(0.3, 0.2, 0.005, stiff, loss_factor=0.0)
    rig = rig_by_keys({**SIDES, "thickness": 0.005, "material": "steel"}, ERA)
    corners = [(x, y) for x in (0.0, 0.3) for y in (0.0, 0.2)]
    foam = [PointLoad(x, y, stiffness=2e3, loss_factor=0.15) for x, y in corners]
    mesh = replace(rig.mesh, length=0.3, width=0.2)
    free = solve_free_plate(plate, mesh, frequency_max=100.0)
    reduced = reduce_free_plate(free, footprints_of(foam))
    heave = supported_modes(reduced, [], loads=foam, frequency_max=100.0)
    assert heave.damping_ratios == pytest.approx([0.075] * 3, rel=2e-3)
    expected = math.sqrt(8e3 / 0.6) / (2 * math.pi)
    assert heave.natural_frequencies[0] == pytest.approx(expected, rel=2e-3)
    frequencies = np.array([10.0, 20.0, 40.0])
    middle = np.array([[0.15, 0.1]])
    found, _ = free.receptances(middle, middle, frequencies, loads=foam)
    omega = 2 * np.pi * frequencies
    receptance = 1 / (8e3 * (1 + 0.15j) - omega**2 * 0.6)
    np.testing.assert_allclose(found[:, 0, 0], receptance, rtol=2e-3)


@pytest.fixture(scope="module")
def table() -> LocalizationTable:
    """A table of the framed board on foam."""
    rig = board(masses=FRAME, supports=FEET, limits={"frequency": [40, 200]})
    problem = TableProblem(rig, np.array([60.0, 150.0]), Grid(3, 2))
    return solve_table(problem, drive_mode="phased")


def test_a_table_follows_a_board_that_is_thicker_and_stiffer(table: LocalizationTable) -> None:
    """Its framed modes move as the independent solver has them at 1.1 times the thickness."""
    rig = board(masses=FRAME, supports=FEET, limits={"frequency": [40, 200]})
    followed = table_following(table, replace(rig, plate=rig.plate.scaled(thickness=1.05)))
    loads = [replace(each, stiffness=0.0) for each in followed.masses]
    shapes = followed.attachment_shapes[1:]
    mass = np.eye(len(followed.omega)) + (shapes.T * [each.mass for each in loads]) @ shapes
    inverse = np.linalg.inv(np.linalg.cholesky(mass))
    squares = np.linalg.eigvalsh(inverse @ np.diag(followed.omega**2) @ inverse.T)
    found = np.sqrt(np.maximum(squares, 0))[3:7] / (2 * np.pi)
    thin, thick = np.array(FRAMED[1.0][:4]), np.array(FRAMED[1.1])
    expected = thin * (thick / thin) ** (math.log(1.05) / math.log(1.1))
    np.testing.assert_allclose(found, expected, rtol=3e-3)
    with pytest.raises(InputError):
        table_following(table, board({"material": {**BIRCH, "E2": 5e9, "rho": 680.0}}))
