"""Materials, laminates and exciters by numbers worked out by hand and by independent solvers.

Also point masses and rigs made without a file; laminates against their bounds, elasticity and
published sandwich plates.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.direct_plate import direct_acceleration
from benchmarks.layers.elasticity import wave_number
from long_form import in_turn, shortly
from model.arrays import ComplexArray, lattice
from model.errors import InputError
from model.fem import assemble
from model.reduction.free_plate import solve_free_plate
from model.structure.attachments import Era, Fingertip, FingertipLoad, PointLoad
from model.structure.exciter import Actuator, Exciter
from model.structure.material import Material, Orthotropy, material
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
from model.vibration import reference_mesh
from plates import exciter_rig, make_paper_rig

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


@pytest.mark.parametrize("held", [False, True])
def test_errors_of_the_suspension_act_as_its_changes_say(held: bool) -> None:
    """Of one that is stiffer or damps more, the force changes as much as the stiffness does.

    At any size, by the motion of its base; and dampers by a difference.
    """
    omega, step = 2 * np.pi * np.array([30.0, 47.0, 120.0, 400.0]), 1e-5
    exciter = replace(BY_HAND, held=held, gains=((100.0, 0.5, 0.3),))
    at_rest, force = exciter.dynamic_stiffness(omega), exciter.force(omega)
    damped = exciter.varied(damping=1 + step).dynamic_stiffness(omega)
    by_damping = exciter.damping * exciter.slopes(omega)["damping"][0]
    assert by_damping == pytest.approx((damped - at_rest) / step, rel=1e-3)
    for key in ("stiffness", "damping"):
        other = exciter.varied(**{key: 1.3})
        pushed = (other.dynamic_stiffness(omega) - at_rest) * exciter.base(omega)
        size = np.abs(force).max()
        assert pushed == pytest.approx(other.force(omega) - force, abs=1e-9 * size)
        drive = exciter.full_level * exciter.gain(omega / (2 * np.pi))
        off = {"stiffness": 1.0, "damping": 1.0, key: 1.3}
        stiffness, by_voltage = exciter.deviating(omega, **off)
        assert stiffness == pytest.approx(exciter.varied(**off).dynamic_stiffness(omega))
        assert by_voltage * drive == pytest.approx(exciter.varied(**off).force(omega))


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


def test_damping_of_suspension_and_current_act_alike() -> None:
    """What one damps 40 % more the current damps less, at as much force: fields within 0.2 %.

    From 40 to 300 Hz, on four coin exciters with 0.6 of c + Bl² / R in the suspension; the
    suspension's alone changes them by 10 % and more.
    """
    rig = exciter_rig("type: DAEX25CT-4", frequency="[40, 300]")
    free = solve_free_plate(rig.plate, rig.mesh, frequency_max=300.0)
    points = lattice(np.linspace(0, 0.3, 7), np.linspace(0, 0.23, 5))
    swapped, damped = [], []
    for each in rig.eras:
        assert isinstance(each, Exciter)
        moved = 0.4 * each.damping
        weaker = np.sqrt(each.force_factor**2 - each.loop_resistance * moved)
        louder = ((100.0, each.force_factor / weaker, 0.0),)
        damped.append(replace(each, damping=each.damping + moved))
        swapped.append(replace(damped[-1], force_factor=float(weaker), gains=louder))

    def fields(eras: Sequence[Actuator]) -> ComplexArray:
        return free.acceleration(eras, np.arange(40.0, 301.0, 10.0), points, loads=rig.masses)

    as_is, alike, other = (fields(each) for each in (rig.eras, swapped, damped))
    size = np.linalg.norm(as_is, axis=(1, 2))
    apart, alone = (np.linalg.norm(each - as_is, axis=(1, 2)) / size for each in (alike, other))
    assert apart.max() < 2e-3
    assert alone.max() > 0.1


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
    """E, rho and nu are those of the source, in SI units."""
    known = material(name)
    assert (known.E, known.rho, known.nu) == PRINTED[name]


@pytest.mark.parametrize("written", ["Soda-lime glass", "soda_lime_glass", " SODA-LIME-GLASS "])
def test_material_accepts_spellings_of_a_name(written):
    """Case and what joins the words do not matter."""
    assert material(written) is material("soda-lime-glass")


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


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (
            lambda rig: {"eras": (*rig.eras, Era("out", 0.31, 0.1, 17000.0, 0.0, 0.0, 1e-4))},
            r"ERA out .*\(0.31, 0.1\)",
        ),
        (lambda _: {"masses": (PointLoad(0.1, -0.01, mass=0.005),)}, r"mass.*\(0.1, -0.01\)"),
        (lambda rig: {"eras": (*rig.eras, replace(rig.era("SW"), name="again"))}, "SW and again"),
        (lambda rig: {"eras": (*rig.eras, replace(rig.era("SW"), x=0.1))}, r"name.*SW|SW.*name"),
    ],
    ids=["ERA off the plate", "mass off the plate", "one place", "one name"],
)
def test_rig_of_a_program_is_checked(change, said):
    """Not only a rig file is: two bolts cannot share a hole, and a name means one ERA."""
    rig = make_paper_rig(12, 9)
    with pytest.raises(InputError, match=said):
        replace(rig, **change(rig))


GRAINED = LaminateLayer(replace(GLASS, orthotropy=Orthotropy(0.4, 0.1, 0.1, 0.1)), 1e-3)


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
    ],
    ids=["no layers", "losses of layers that slide", "layers with a grain", "no elastic energy"],
)
def test_plates_of_no_meaning_are_refused(made, said):
    """Bounds and waves of a laminate are those of isotropic layers."""
    with pytest.raises(InputError, match=said):
        made()


PLY_GLASS = Material("glass", E=70e9, rho=2500.0, nu=0.2)
ALUMINIUM = Material("aluminium", E=70e9, rho=2700.0, nu=0.33)
STEEL = Material("steel", E=210e9, rho=7850.0, nu=0.3)
FOAM = Material("foam", E=70e6, rho=100.0, nu=0.33)
ADHESIVE = Material("adhesive", E=1e6, rho=1000.0, nu=0.49)
PANEL = (
    LaminateLayer(PLY_GLASS, 1.8e-3),
    LaminateLayer(ADHESIVE, 0.2e-3),
    LaminateLayer(PLY_GLASS, 0.7e-3),
)


def of_plate(laminate, **changes):
    """The plate of a laminate, of some size."""
    return equivalent_plate(laminate, length=0.4, width=0.25, frequency=150.0, **changes)


def test_bonded_layers_equal_laminate_theory():
    """D* = D - B A⁻¹ B with the full 3x3 matrices, from any reference plane."""
    layers = [
        LaminateLayer(STEEL, 0.5e-3),
        LaminateLayer(PLY_GLASS, 2e-3),
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


def test_equivalent_plate_keeps_rotary_inertia():
    """Bonded glass: rho H³ / 12 of the whole; sliding: of each; a sandwich: faces at their arms."""
    three = (LaminateLayer(PLY_GLASS, 1e-3),) * 3
    assert of_plate(Laminate(three)).thickness == pytest.approx(3e-3, rel=1e-3)
    assert of_plate(Laminate(three, Bond.NONE)).thickness == pytest.approx(1e-3, rel=1e-9)
    stiff = replace(FOAM, E=7e9)
    sandwich = Laminate(
        (
            LaminateLayer(ALUMINIUM, 1e-3),
            LaminateLayer(stiff, 10e-3),
            LaminateLayer(ALUMINIUM, 1e-3),
        )
    )
    inertia = 2 * (2.7 * 1e-6 / 12 + 2.7 * 5.5e-3**2) + 1.0 * 1e-4 / 12
    plate = of_plate(sandwich)
    assert plate.material.rho * plate.thickness**3 / 12 == pytest.approx(inertia, rel=0.02)


@pytest.mark.parametrize(
    ("modulus", "frequency"), in_turn([0.1e6, 1e6, 10e6, 1e9], [40.0, 150.0, 500.0, 2000.0])
)
def test_waves_equal_elasticity(modulus, frequency):
    """Frequency of a wave within 0.5 % for adhesives from gel to epoxy, over the limits of a rig.

    At one wavenumber the frequency differs twice as much as the wavenumber at one frequency.
    """
    adhesive = Material("adhesive", E=modulus, rho=1000.0, nu=0.49)
    layers = (PANEL[0], LaminateLayer(adhesive, 0.2e-3), PANEL[2])
    expected = wave_number(layers, frequency)
    assert wavenumber_of(Laminate(layers), frequency).real == pytest.approx(expected, rel=0.0025)


def test_waves_on_two_adhesives_equal_elasticity():
    """Cover, sensor and display glass on two different adhesives, frequency within 0.1 %."""
    other = Material("other", E=3e6, rho=1000.0, nu=0.49)
    layers = (*PANEL, LaminateLayer(other, 0.1e-3), LaminateLayer(PLY_GLASS, 1.1e-3))
    k = wavenumber_of(Laminate(layers), 150.0).real
    assert k == pytest.approx(wave_number(layers, 150.0), rel=5e-4)


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


def test_sliding_layers_add_their_rigidities():
    """Two equal layers are twice one, a quarter of the bonded pair; others add up by hand."""
    two = [LaminateLayer(PLY_GLASS, 1e-3), LaminateLayer(PLY_GLASS, 1e-3)]
    assert freely_sliding(two).rigidity == pytest.approx(2 * 70 / (12 * 0.96), rel=1e-12)
    assert perfectly_bonded(two).rigidity / freely_sliding(two).rigidity == pytest.approx(4)
    mixed = freely_sliding([LaminateLayer(STEEL, 1e-3), LaminateLayer(PLY_GLASS, 2e-3)])
    steel, glass = 210 / (12 * 0.91), 560 / (12 * 0.96)
    assert mixed.rigidity == pytest.approx(steel + glass, rel=1e-12)
    assert mixed.nu == pytest.approx((0.3 * steel + 0.2 * glass) / (steel + glass), rel=1e-12)
