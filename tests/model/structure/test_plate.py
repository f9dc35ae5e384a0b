"""Materials, laminates, exciters and attachments, by hand and by independent solvers.

Laminates are compared with their bounds, elasticity and published sandwich plates; attachments are
supports, loads at points and on areas, fingertips, frames and feet. Also boards with a grain, and
rigs that are made without a file.
"""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from cases import in_turn, shortly
from kit.direct_plate import direct_acceleration
from kit.layered_strips import wave_number
from kit.plates import ALUMINIUM, exciter_rig, make_paper_rig
from model.arrays import FloatArray, lattice
from model.errors import InputError
from model.fem import ELEMENTS, Mesh, assemble
from model.reduction.free_plate import solve_free_plate
from model.reduction.reduced_plate import reduce_free_plate
from model.reduction.supported_plate import supported_modes
from model.rig.rig import Rig
from model.rig.rig_writing import rig as rig_by_keys
from model.structure.attachments import PointLoad, footprints_of
from model.structure.exciter import Exciter
from model.structure.fingertips import Fingertip, FingertipLoad
from model.structure.footprints import mean_over
from model.structure.material import Material, Orthotropy, known_material, material
from model.structure.plate import (
    AirGap,
    Bond,
    Laminate,
    LaminateLayer,
    Plate,
    bending,
    equivalent_plate,
    freely_sliding,
    perfectly_bonded,
    shear_corrections,
    wave_rigidity,
    wavenumber_of,
)
from model.structure.sources import Era
from model.structure.statics import (
    GRAVITY,
    check_supported,
    rigid_body_frequencies,
    static_loads,
    support_problem,
)
from model.vibration import natural_modes, reference_mesh

# DAEX25FHE-4 of its sheet with Qms 3, R_g 0.1 ohm, 1 W.
BY_HAND = Exciter(
    "SW",
    0.1,
    0.1,
    stiffness=3189.20,
    damping=0.7553,
    magnet_mass=0.10929,
    coil_mass=1.61e-3,
    force_factor=3.63,
    resistance=4.3,
    voltage=3.0008,
    source_resistance=0.1,
    inductance=1e-4,
)


@pytest.mark.parametrize(
    ("frequency", "force", "stiffness", "held"),
    [
        (20, -2.6413 + 0.8583j, -3594.3 + 593.1j, False),
        (60, 3.0801 + 0.3263j, 3546.1 + 2213.0j, False),
        (100, 2.6675 + 0.1192j, 2677.8 + 2741.1j, False),
        (250, 2.5044 - 0.0340j, -706.5 + 6031.0j, False),
        (100, 2.4751 - 0.0353j, 2580.5 + 2355.9j, True),
    ],
)
def test_force_and_dynamic_stiffness_by_hand(
    frequency: float, force: complex, stiffness: complex, held: bool
) -> None:
    """Of a magnet that is free, and of one that a frame holds, to the digits worked out."""
    omega = 2 * np.pi * np.array([frequency])
    exciter = replace(BY_HAND, held=held)
    assert exciter.force(omega)[0] == pytest.approx(force, rel=1e-4)
    assert exciter.dynamic_stiffness(omega)[0] == pytest.approx(stiffness, rel=1e-4)


@pytest.mark.parametrize("magnet", shortly(["free", "held"], ["free"]))
def test_response_on_a_board_against_magnet_and_current_solved_beside_it(magnet: str) -> None:
    """Finite elements with the magnets' and the coils' own equations: within 0.3 % of the field.

    Of four exciters on acrylic on foam, under a finger, at four frequencies from 40 to 500 Hz.
    """
    keys = f"type: DAEX25FHE-4, magnet: {magnet}"
    rig = exciter_rig(keys, frequency="[40, 500]", more="mesh: auto 0.1 %")
    finger = FingertipLoad(0.11, 0.09, Fingertip())
    frequencies = np.array([40.0, 107.0, 240.0, 500.0])
    points = lattice(np.linspace(0, 0.3, 13), np.linspace(0, 0.23, 10))
    free = solve_free_plate(rig.plate, rig.mesh, frequency_max=500.0)
    loads = (*rig.masses, finger)
    found = free.acceleration(rig.eras, frequencies, points, loads=loads)
    mesh = reference_mesh(rig.plate, frequency_max=500.0)
    expected = direct_acceleration(
        assemble(rig.plate, mesh), rig.eras, frequencies, points, loads=loads
    )
    apart = np.linalg.norm(found - expected, axis=2) / np.linalg.norm(expected, axis=2)
    assert apart.max() < 3e-3


GLASS = Material("glass", 70e9, 2500.0, 0.2)
PLATE = Plate(0.3, 0.2, 0.002, GLASS)

# E [Pa], rho [kg/m³], nu as printed in the standard or data sheet that the material names.
PRINTED = {
    "aluminium": (70e9, 2700, 0.33),  # founding paper, section 3
    "steel": (210e9, 7850, 0.3),  # EN 1993-1-1, 3.2.6; EN 1991-1-1
    "soda-lime-glass": (70e9, 2500, 0.2),  # EN 572-1
    "chemically-strengthened-glass": (71.5e9, 2420, 0.21),  # Corning Gorilla Glass 2
    "float-glass": (70e9, 2500, 0.2),  # EN 572-1
    "polycarbonate": (2.4e9, 1200, 0.38),  # Makrolon
}


@pytest.mark.parametrize("name", PRINTED)
def test_material_has_the_printed_numbers(name):
    """E, rho and nu are those of the source, in SI units; a name may be written in other ways."""
    known = material(name)
    assert (known.E, known.rho, known.nu) == PRINTED[name]
    for written in (
        name.replace("-", " ").capitalize(),
        name.replace("-", "_"),
        f" {name.upper()} ",
    ):
        assert material(written) is known


@pytest.mark.parametrize(
    ("good", "values"),
    [
        (material("steel"), {"E": [0.0, math.nan], "rho": [-1.0], "nu": [0.5, -1.0, math.nan]}),
        (PLATE, {key: [0.0, -0.1, math.nan, math.inf] for key in ("length", "width", "thickness")}),
        (LaminateLayer(GLASS, 1e-3), {"thickness": [0.0, -1e-3, math.nan, math.inf]}),
        (
            PointLoad(0.1, 0.1),
            {
                "x": [math.nan],
                "y": [math.inf],
                "mass": [math.nan, -0.1],
                "stiffness": [-1.0],
                "damping": [math.inf],
                "foot": [-1e-3, math.nan],
            },
        ),
        (Era("A", 0.1, 0.1, 1e4, 1.0, 0.0, 1e-4), {"stroke": [0.0], "foot": [-1e-3, math.nan]}),
        (
            Exciter("SW", 0.1, 0.1, 3e3, 0.8, 0.1, 2e-3, 3.6, 4.3, 3.0),
            {key: [0.0] for key in ("stiffness", "magnet_mass", "force_factor", "resistance")},
        ),
        (Orthotropy(0.4, 0.1, 0.1, 0.1), {"e2": [math.nan, 0.0], "g13": [-1.0]}),
        (replace(GLASS, orthotropy=Orthotropy(0.4, 0.1, 0.1, 0.1)), {"E": [0.0]}),
        (Fingertip(), {"damping": [0.0], "stiffness": [-1.0], "phalanx_mass": [math.nan, 0.0]}),
        (AirGap(1e-3), {"depth": [0.0, -1e-3, math.nan]}),
    ],
    ids=lambda value: type(value).__name__,
)
def test_value_refuses_numbers_out_of_range(good, values):
    """The error names the key and the number."""
    for key, numbers in values.items():
        for number in numbers:
            with pytest.raises(InputError, match=rf"{key} .*got {number}"):
                replace(good, **{key: number})


GRAINED = LaminateLayer(replace(GLASS, orthotropy=Orthotropy(0.4, 0.1, 0.1, 0.1)), 1e-3)
PAPER = make_paper_rig(12, 9)


@pytest.mark.parametrize(
    ("made", "said"),
    [
        (lambda: Laminate(()), r"^laminate: .*layer"),
        (
            lambda: Laminate((replace(GRAINED, material=GLASS, loss_factor=0.1),) * 2, Bond.NONE),
            r"^laminate: .*bond none",
        ),
        (lambda: Laminate((GRAINED, GRAINED)), "isotropic"),
        # 1 / sqrt(0.4) = 1.58
        (lambda: replace(GRAINED.material, nu=1.6), "nu12 must be less than .*1.58"),
        (
            lambda: replace(
                PAPER, eras=(*PAPER.eras, Era("out", 0.31, 0.1, 17000.0, 0.0, 0.0, 1e-4))
            ),
            r"ERA out .*\(0.31, 0.1\)",
        ),
        (
            lambda: replace(PAPER, masses=(PointLoad(0.1, -0.01, mass=0.005),)),
            r"mass.*\(0.1, -0.01\)",
        ),
        (
            lambda: replace(PAPER, eras=(*PAPER.eras, replace(PAPER.era("SW"), name="again"))),
            "SW and again",
        ),
        (
            lambda: replace(PAPER, eras=(*PAPER.eras, replace(PAPER.era("SW"), x=0.1))),
            r"name.*SW|SW.*name",
        ),
    ],
    ids=[
        *("no layers", "losses of layers that slide", "layers with a grain", "no elastic energy"),
        *("ERA off the plate", "mass off the plate", "one place", "one name"),
    ],
)
def test_plates_and_rigs_of_no_meaning_are_refused(made, said):
    """Bounds and waves of a laminate are those of isotropic layers.

    Not only a rig file is checked: two bolts cannot share a hole, and a name means one ERA.
    """
    with pytest.raises(InputError, match=said):
        made()


STEEL = Material("steel", E=210e9, rho=7850.0, nu=0.3)
FOAM = Material("foam", E=70e6, rho=100.0, nu=0.33)
ADHESIVE = Material("adhesive", E=1e6, rho=1000.0, nu=0.49)
PANEL = (
    LaminateLayer(GLASS, 1.8e-3),
    LaminateLayer(ADHESIVE, 0.2e-3),
    LaminateLayer(GLASS, 0.7e-3),
)


def of_plate(laminate, **changes):
    """The plate of a laminate, of some size."""
    return equivalent_plate(laminate, length=0.4, width=0.25, frequency=150.0, **changes)


def test_bonded_layers_equal_laminate_theory():
    """D* = D - B A⁻¹ B with the full 3x3 matrices, from any reference plane."""
    layers = [
        LaminateLayer(STEEL, 0.5e-3),
        LaminateLayer(GLASS, 2e-3),
        LaminateLayer(FOAM, 1e-3),
    ]
    A, B, D = (np.zeros((3, 3)) for _ in range(3))
    z = -0.7e-3
    for layer in layers:
        nu, h = layer.material.nu, layer.thickness
        Q = (
            layer.material.E
            / (1 - nu**2)
            * np.array([[1, nu, 0], [nu, 1, 0], [0, 0, (1 - nu) / 2]])
        )
        A += Q * h
        B += Q * ((z + h) ** 2 - z**2) / 2
        D += Q * ((z + h) ** 3 - z**3) / 3
        z += h
    whole = D - B @ np.linalg.solve(A, B)
    bent = perfectly_bonded(layers)
    expected = bent.rigidity * np.array(
        [[1, bent.nu, 0], [bent.nu, 1, 0], [0, 0, (1 - bent.nu) / 2]]
    )
    np.testing.assert_allclose(whole, expected, rtol=1e-9, atol=1e-9 * bent.rigidity)


@pytest.mark.parametrize("bond", ["full", "none"])
def test_equivalent_plate_keeps_rigidity_nu_and_mass(bond):
    """What is like the laminate carries D, nu and the surface density, by hand 6.45 kg/m²."""
    laminate = Laminate(PANEL, Bond(bond))
    plate = of_plate(laminate, loss_factor=0.02)
    bent = bending(laminate, 150.0)
    assert plate.flexural_rigidity == pytest.approx(bent.rigidity, rel=1e-8)
    assert plate.material.nu == pytest.approx(bent.nu, rel=1e-8)
    assert plate.mass == pytest.approx(6.45 * 0.4 * 0.25, rel=1e-8)
    assert (plate.length, plate.width, plate.loss_factor) == (0.4, 0.25, 0.02)
    assert plate.laminate == (laminate if bond == "full" else None)


@pytest.mark.parametrize(
    ("modulus", "frequency"),
    [
        *in_turn([1e6, 10e6, 1e9], [40.0, 500.0, 2000.0]),
        # Glass on the softest gel slides by itself at 1.4 kHz: the theory holds to half of that.
        *in_turn([0.1e6], [150.0, 40.0, 650.0]),
    ],
)
def test_waves_equal_elasticity(modulus, frequency):
    """Frequency of a wave within 0.5 % for adhesives from gel to epoxy, over the limits of a rig.

    At one wavenumber the frequency differs twice as much as the wavenumber at one frequency. Cover,
    sensor and display glass on two different adhesives are within the same.
    """
    adhesive = LaminateLayer(Material("adhesive", E=modulus, rho=1000.0, nu=0.49), 0.2e-3)
    other = LaminateLayer(Material("other", E=3e6, rho=1000.0, nu=0.49), 0.1e-3)
    one = (PANEL[0], adhesive, PANEL[2])
    for layers in (one, (*one, other, LaminateLayer(GLASS, 1.1e-3))):
        expected = wave_number(layers, frequency)
        found = wavenumber_of(Laminate(layers), frequency).real
        assert found == pytest.approx(expected, rel=0.0025)


def test_simply_supported_sandwich_equals_published_frequencies_and_losses():
    """Five modes of a damped sandwich plate within 0.3 %, losses within 0.001.

    Analytical values after Abdulhadi, as in Johnson and Kienholz, AIAA J. 20 (1982) 1284, table 3.
    The modes of a simply supported plate are standing waves of its wavenumbers.
    """
    face = LaminateLayer(Material("face", E=68.9e9, rho=2740.0, nu=0.3), 0.762e-3)
    core = Material("core", E=0.896e6 * 2 * 1.49, rho=999.0, nu=0.49)
    laminate = Laminate((face, LaminateLayer(core, 0.254e-3, loss_factor=0.5), face))
    published = {
        (1, 1): (60.3, 0.190),
        (2, 1): (115.4, 0.203),
        (1, 2): (130.6, 0.199),
        (2, 2): (178.7, 0.181),
        (3, 1): (195.7, 0.174),
    }
    for (m, n), (frequency, loss) in published.items():
        k = math.pi * math.hypot(m / 0.348, n / 0.3048)
        square = wave_rigidity(laminate, k, 100.0) * k**4 / laminate.surface_density
        assert math.sqrt(square.real) / (2 * math.pi) == pytest.approx(frequency, rel=3e-3)
        assert square.imag / square.real == pytest.approx(loss, abs=1e-3)


def test_shear_corrections_are_those_of_one_layer_and_of_a_soft_core():
    """5/6 of a single layer (Reissner), 1 where shear is uniform, 3/4 where it grows from zero."""
    assert shear_corrections(PANEL[:1]) == pytest.approx([5 / 6])
    face = LaminateLayer(ALUMINIUM, 1e-5)
    corrections = shear_corrections((face, LaminateLayer(FOAM, 1e-2), face))
    assert corrections == pytest.approx([0.75, 1.0, 0.75], abs=5e-3)


def test_modulus_by_frequency_is_a_power_law_between_rows():
    """Half way in the logarithm of frequency E is the geometric mean; outside it is constant."""
    layer = LaminateLayer(FOAM, 1e-3, by_frequency=((10.0, 0.25, 0.2), (1000.0, 4.0, 0.6)))
    assert layer.modulus(100.0) == pytest.approx(70e6 * (1 + 0.4j))
    assert layer.modulus(1.0) == pytest.approx(0.25 * 70e6 * (1 + 0.2j))
    assert layer.modulus(5e3) == pytest.approx(4 * 70e6 * (1 + 0.6j))


@pytest.mark.parametrize(
    "rows",
    [
        [(0.0, 1.0, 0.1)],
        [(100.0, 0.0, 0.1)],
        [(100.0, 1.0, math.nan)],
        [(100.0, 1.0, 0.1), (100.0, 2.0, 0.1)],
    ],
    ids=["zero frequency", "zero factor", "loss that is no number", "equal frequencies"],
)
def test_layer_refuses_rows_without_a_modulus(rows):
    """The logarithm of zero and the ratio of equal frequencies have no value."""
    with pytest.raises(InputError, match="by_frequency must have rows"):
        LaminateLayer(FOAM, 1e-3, by_frequency=tuple(rows))


def test_sliding_layers_add_their_rigidities():
    """Two equal layers are twice one, a quarter of the bonded pair; others add up by hand."""
    two = [LaminateLayer(GLASS, 1e-3)] * 2
    assert freely_sliding(two).rigidity == pytest.approx(2 * 70 / (12 * 0.96), rel=1e-12)
    assert perfectly_bonded(two).rigidity / freely_sliding(two).rigidity == pytest.approx(4)
    mixed = freely_sliding([LaminateLayer(STEEL, 1e-3), LaminateLayer(GLASS, 2e-3)])
    steel, glass = 210 / (12 * 0.91), 560 / (12 * 0.96)
    assert mixed.rigidity == pytest.approx(steel + glass, rel=1e-12)
    assert mixed.nu == pytest.approx((0.3 * steel + 0.2 * glass) / (steel + glass), rel=1e-12)


ATTACHMENTS_PLATE = Plate(0.3, 0.2, 0.002, ALUMINIUM)


def era(name: str, x: float, y: float, stiffness: float = 17e3, bolt_mass: float = 0.0) -> Era:
    """An ERA at x, y [m]."""
    return Era(name, x, y, stiffness, damping=1.0, bolt_mass=bolt_mass, stroke=1e-4)


CORNERS = [era("SW", 0, 0), era("SE", 0.3, 0), era("NE", 0.3, 0.2), era("NW", 0, 0.2)]


@pytest.mark.parametrize(
    ("loads", "slower"),
    [([], 1.0), ([PointLoad(0.15, 0.1, mass=ATTACHMENTS_PLATE.mass)], math.sqrt(2))],
)
def test_rigid_body_frequencies_are_those_of_the_textbook(
    loads: list[PointLoad], slower: float
) -> None:
    """Heave sqrt(4k/m); each tilt of four corner springs sqrt(12 k/m).

    A mass of the plate's own at its center slows the heave alone, by sqrt(2).
    """
    heave = math.sqrt(4 * 17e3 / ATTACHMENTS_PLATE.mass) / (2 * math.pi)
    expected = [heave / slower, math.sqrt(3) * heave, math.sqrt(3) * heave]
    found = rigid_body_frequencies(ATTACHMENTS_PLATE, CORNERS, loads=loads)
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
def test_plate_is_supported_by_three_springs_not_in_line(eras: list[Era]) -> None:
    """Not by fewer, all in one line, or too soft ones.

    Corner ERAs hold heave and both tilts; springs of loads count as those of ERAs do.
    """
    assert support_problem(ATTACHMENTS_PLATE, eras) is not None
    with pytest.raises(InputError, match=r"supported.*; put"):
        check_supported(ATTACHMENTS_PLATE, eras)
    for held, loads in ((4, []), (3, []), (2, [PointLoad(0.15, 0.2, 17e3)])):
        assert support_problem(ATTACHMENTS_PLATE, CORNERS[:held], loads=loads) is None


HERTZ = np.array([60.0, 100.0, 250.0])


@pytest.mark.parametrize(
    ("fingertip", "hertz", "expected"),
    [
        (Fingertip(), HERTZ, [69, -87, -358]),
        (Fingertip(phalanx_mass=1e9), HERTZ, [972, 921, 507]),
        (Fingertip().scaled(2), np.zeros(1), [2000 * 500 / 2500]),
        (Fingertip(stiffness=0.0, joint_stiffness=0.0), np.zeros(1), [0]),
    ],
    ids=["phalanx that moves", "phalanx at rest", "twice the contact at rest", "no springs"],
)
def test_dynamic_stiffness_of_a_fingertip(
    fingertip: Fingertip, hertz: FloatArray, expected: list[float]
) -> None:
    """Real parts as worked out from the formula by hand; scaled pulp and joint are in series."""
    found = fingertip.dynamic_stiffness(2 * np.pi * hertz)
    assert found.real == pytest.approx(expected, abs=1)
    assert (found.imag >= 2 * np.pi * hertz * (0.1 if fingertip.phalanx_mass < 1 else 1.999)).all()


LONG, WIDE, A = 0.3, 0.2, 0.01


def test_an_annular_wave_averages_to_the_bessel_function():
    """The mean of cos(k x) over a whole disc is 2 J1(k a) / (k a): 0.88010117 at k a = 1."""
    places = np.array([[0.1, 0.08, A], [0.2, 0.1, 0.0]])
    found = mean_over(lambda at: np.cos((at[:, :1] - 0.1) / A), places, length=LONG, width=WIDE)
    assert found[0, 0] == pytest.approx(0.88010117, rel=1e-6)
    assert found[1, 0] == pytest.approx(math.cos(0.1 / A))


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


@pytest.mark.parametrize(
    ("rig", "mesh", "expected", "within"),
    [
        # Without transverse shear these would be up to 2.4 % higher.
        (board(), None, BARE, 2e-4),
        (board(), ELEMENTS_Q5, BARE, 2e-4),
        # A frame that scaled with the board would have 43.85 Hz in place of 43.25.
        *(
            (board({"thickness": by * 6.4e-3}, masses=FRAME), None, hertz, 3e-3)
            for by, hertz in FRAMED.items()
        ),
    ],
    ids=["polynomials", "elements", *(f"{by:g} times as thick, framed" for by in FRAMED)],
)
def test_a_free_board_has_the_modes_of_an_independent_solver(
    rig: Rig, mesh: Mesh | None, expected: list[float], within: float
) -> None:
    """Eight modes within 0.02 %, or 0.3 % of boards of any thickness that a frame moves."""
    np.testing.assert_allclose(modes(rig, len(expected), mesh), expected, rtol=within)


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
        (layer,) = rig.plate.laminate.layers
        moduli = [layer.modulus(frequency) for frequency in (10.0, 100.0, 1000.0)]
        expected = [4.2e9 * (1 + 0.075j), 4.6e9 * (1 + 0.06j), 5e9 * (1 + 0.045j)]
        np.testing.assert_allclose(moduli, expected, rtol=1e-9)


def test_feet_hold_the_weight_of_board_and_frame() -> None:
    """Three feet and an ERA carry 0.522 kg of board and 70 g of frame; two feet do not hold it.

    A frame that holds the edges has its stiffness in all: 1.4 m at 5 kN/m² are 7 kN/m, with the
    damper that is given for all of it.
    """
    rig = board(masses=FRAME, supports=FEET)
    assert support_problem(rig.plate, rig.eras, loads=rig.masses) is None
    loads = static_loads(rig.plate, rig.eras, loads=rig.masses)
    weight = GRAVITY * (680 * 0.4 * 0.3 * 6.4e-3 + 1.4 * 0.05)
    assert len(loads) == 4
    assert loads.sum() == pytest.approx(weight, rel=1e-9)
    two = board(supports={"SW": FEET["SW"]})
    assert support_problem(two.plate, two.eras, loads=two.masses) is not None
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
