import math
from pathlib import Path

import pytest

from model.config.document import ConfigError, read_document
from model.errors import InputError
from model.rig.file import load_rig
from model.rig.kind import RIG
from model.rig.meshes import parse_mesh
from model.rig.rig import Channel
from model.rig.uncertainty import Uncertainty
from model.structure.attachments import Fingertip, PointLoad
from model.structure.materials import material
from model.structure.plate import Plate

# A line per value, so that every problem has a line of its own.
GOOD = """\
plate:
  length: 12 in
  width: 9 in
  thickness: 1.5 mm
  material: aluminium
mesh: 48x36
eras:
  SW:
    at: [0, 0]
    stiffness: 17 kN/m
    damping: 2.0
    amplifier: main
    channel: 0
  NE:
    at: [0.3048, 228.6 mm]
    stiffness: 17000
    amplifier: main
    channel: 1
amplifiers:
  main: {url: "sim://"}
limits:
  frequency: [40, 500]
  level: 0.5
"""


def write(folder: Path, text: str) -> Path:
    """A rig file of this text."""
    path = folder / "rig.yaml"
    path.write_text(text, encoding="utf-8")
    return path


LAYERS = """\
  layers:
    - material: aluminium
      thickness: 1 mm
    - material: {E: 1 MPa, rho: 1000, nu: 0.49}
      thickness: 0.2 mm
    - {material: acrylic, thickness: 2 mm}
  bond: full
"""
LAMINATE = GOOD.replace("  thickness: 1.5 mm\n  material: aluminium\n", LAYERS).replace(
    "48x36", "auto"
)
BOARD = (
    "{E1: 12 GPa, E2: 5 GPa, G12: 1 GPa, G13: 1 GPa, G23: 1 GPa, nu12: 0.1, rho: 700}"  # of wood
)
AT_EDGE, FOOT = "  level: 0.5\nmasses:\n  a", "  level: 0.5\nsupports:\n  a"
MASS = "masses:\n  cam:\n    at: [0, 0]\n    mass: 5 g"


def refused(folder: Path, text: str) -> list[tuple[int | None, str, str]]:
    """The problems for which a text is refused: line, key, message."""
    with pytest.raises(ConfigError) as caught:
        load_rig(write(folder, text))
    return [(problem.line, problem.key, problem.message) for problem in caught.value.problems]


def check_refusal(
    folder: Path, good: str, lines: int | tuple[int, int], text: str, where: str
) -> None:
    """Replace lines of a good rig; where: `LINE key, suggestion` of an expected problem."""
    first, last = lines if isinstance(lines, tuple) else (lines, lines)
    rows = good.splitlines()
    rows[first - 1 : last] = text.splitlines()
    place, _, suggestion = where.partition(", ")
    line, key = place.split(" ", 1)
    assert any(
        (at, name) == (int(line), key)
        and f"did you mean {suggestion}?" in f"{message}did you mean ?"
        for at, name, message in refused(folder, "\n".join(rows))
    )


@pytest.mark.parametrize(
    ("lines", "text", "where"),
    [
        (2, "  length: .nan", "2 plate.length"),
        (2, "  length:", "2 plate.length"),
        (2, "  length: 304.8", "2 plate.length"),
        (2, "  length: 12 in\n  colour: red", "3 plate.colour"),
        (4, "  thickness: -1.5 mm", "4 plate.thickness"),
        (5, "", "1 plate.material"),
        (5, "  material: 7", "5 plate.material"),
        (5, "  material: soda glass", "5 plate.material, soda-lime-glass"),
        (5, "  material: {E: 70 GPa, rho: 2700, nu: -1}", "5 plate.material.nu"),
        (5, "  material: {E: 70 GPa, nu: 0.3}", "5 plate.material.rho"),
        (5, "  material: {E: 1, rho: 0, nu: 0, F: 1}", "5 plate.material.F"),
        (5, "  material: {E: 70 GPa, rho: 2700}", "5 plate.material.nu"),
        (5, "  material: {E: 70 GPa, rho: 2700, nu: 0.3, G12: 1 GPa}", "5 plate.material.G12"),
        (5, "  material: {rho: 2700}", "5 plate.material.E"),
        (5, f"  material: {BOARD.replace('nu12: 0.1', 'nu12: 2')}", "5 plate.material"),
        (5, f"  material: {BOARD.replace(', G23: 1 GPa', '')}", "5 plate.material.G23"),
        (5, f"  material: {BOARD.replace('rho', 'nu: 0.3, rho')}", "5 plate.material.nu"),
        (5, "  material: steel\n  grain: wide", "6 plate.grain"),
        # 0.3048 m / (0.17132 m / 6) = 10.67 and 0.2286 m / (0.17132 m / 6) = 8.01
        (6, "mesh: 10x9", "6 mesh"),
        (6, "mesh: 11x8", "6 mesh"),
        (6, "mehs: 48x36", "6 mehs, mesh"),
        ((7, 18), "eras: {}", "7 eras"),
        ((7, 18), "", "1 eras"),
        (9, "    at: [0, 0, 0]", "9 eras.SW.at"),
        (9, "    at: [0]", "9 eras.SW.at[1]"),
        (9, "    at: [0, 1 kg]", "9 eras.SW.at[1]"),
        (9, "    at: [0, 9.1 in]", "9 eras.SW.at"),
        (9, "    at: [-1 mm, 0]", "9 eras.SW.at"),
        (10, "    stiffness: 17 N", "10 eras.SW.stiffness"),
        (10, "", "8 eras.SW.stiffness"),
        (11, "    stroke: 100", "11 eras.SW.stroke"),
        (12, "", "8 eras.SW.amplifier"),
        (13, "    channel: 0.5", "13 eras.SW.channel"),
        (13, "    channel: '0'", "13 eras.SW.channel"),
        (20, "  main: sim://", "20 amplifiers.main"),
        (20, '  main: {url: "sim://", clock_error: 2 ms}', "20 amplifiers.main.clock_error"),
        (22, "  frequency: [0, 500]", "22 limits.frequency[0]"),
        (22, "  frequency: [40, 500 rpm]", "22 limits.frequency[1]"),
        (23, "  level: .nan", "23 limits.level"),
        (23, "  slew: 5 s", "23 limits.slew"),
        (23, "  on_time: 5 Hz", "23 limits.on_time"),
        (23, "  rate: 3 kHz", "23 limits.rate"),
        (23, "  level: 0.5\nmasses: 2", "24 masses"),
        (23, "  level: 0.5\nuncertainty:", "24 uncertainty"),
        (23, "  level: 0.5\n" + MASS.replace("\n    mass: 5 g", ""), "25 masses.cam.mass"),
        (23, "  level: 0.5\n" + MASS.replace("cam", "2nd"), "25 masses.2nd"),
        (23, f"{AT_EDGE}: {{mass: 1 g}}", "25 masses.a.at"),
        (23, f"{AT_EDGE}: {{along: edges}}", "25 masses.a.mass_per_length"),
        (23, f"{AT_EDGE}: {{along: edges, mass: 1, mass_per_length: 1}}", "25 masses.a.mass"),
        (23, f"{AT_EDGE}: {{at: [0, 0], mass: 1, points: 50}}", "25 masses.a.points"),
        (23, f"{FOOT}: {{at: [0, 0]}}", "25 supports.a.stiffness"),
        (23, f"{FOOT}: {{at: [0, 1], kind: foam}}", "25 supports.a.at"),
        (23, f"{FOOT}: {{at: [0, 0], kind: foams}}", "25 supports.a.kind, foam"),
        (23, f"{FOOT}: {{at: [0, 0], stiffness: 2 MN/m}}", "25 supports.a.foot"),
        (23, f"{FOOT}: {{along: edges, kind: foam}}", "25 supports.a.kind"),
        (23, f"{FOOT}: {{along: edges}}", "25 supports.a.stiffness_per_length"),
        (23, "  level: 0.5\nplates: 2", "24 plates, plate"),
        (23, "  level: 0.5\nfingertip: 5", "24 fingertip"),
        (23, "  level: 0.5\nfingertip: {phalanx: 1 g}", "24 fingertip.phalanx, phalanx_mass"),
    ],
)
def test_load_rig_refuses_an_invalid_value_with_line_and_key(
    tmp_path: Path, lines: int | tuple[int, int], text: str, where: str
) -> None:
    """Each kind of value, section and reference is checked; a mistyped name gets a suggestion."""
    check_refusal(tmp_path, GOOD, lines, text, where)


@pytest.mark.parametrize(
    ("lines", "text", "where"),
    [
        ((4, 9), "  layers: []", "4 plate.layers"),
        ((4, 9), "  layers:\n    - 7", "5 plate.layers[0]"),
        ((4, 9), "  layers: {a: 1}", "4 plate.layers"),
        (4, "  thickness: 1 mm\n  layers:", "4 plate.thickness"),
        (4, "  material: steel\n  layers:", "4 plate.material"),
        (5, "    - material: aluminum", "5 plate.layers[0].material, aluminium"),
        (6, "      thicknes: 1 mm", "6 plate.layers[0].thicknes, thickness"),
        (6, "      thickness: 0", "6 plate.layers[0].thickness"),
        (6, "      thickness: 300 mm", "4 plate.layers"),
        (7, "    - material: {E: 1 MPa, rho: 1000, nu: 0, t: 1}", "7 plate.layers[1].material.t"),
        (8, "", "7 plate.layers[1].thickness"),
        (8, "      loss_factor: 3\n      thickness: 1 mm", "8 plate.layers[1].loss_factor"),
        (
            8,
            "      thickness: 1 mm\n      by_frequency: [[20, 1, 0], [10, 1, 0]]",
            "9 plate.layers[1].by_frequency",
        ),
        (
            8,
            "      thickness: 1 mm\n      by_frequency: [[20, 0, 0], [30, 1, 0]]",
            "9 plate.layers[1].by_frequency",
        ),
        ((8, 10), "      thickness: 1 mm\n      loss_factor: 0.1\n  bond: none", "10 plate.bond"),
        (10, "  bond: glue", "10 plate.bond"),
        (10, "  bond: shear", "10 plate.bond"),
    ],
)
def test_load_rig_refuses_an_invalid_laminate_with_line_and_key(
    tmp_path: Path, lines: int | tuple[int, int], text: str, where: str
) -> None:
    """The key leads to the layer that is wrong."""
    check_refusal(tmp_path, LAMINATE, lines, text, where)


@pytest.mark.parametrize("text", ["48x36", "48X36", " 48 x 36 ", "48×36"])
def test_parse_mesh_accepts_common_spellings(text: str) -> None:
    """Spaces, case and the multiplication sign do not matter."""
    mesh = parse_mesh(text, Plate(0.4, 0.3, 0.002, material("aluminium")))
    assert (mesh.nx, mesh.ny, mesh.length, mesh.width) == (48, 36, 0.4, 0.3)


def test_load_rig_reads_units_defaults_wiring_and_limits(tmp_path: Path) -> None:
    """Units are converted, defaults filled in, wiring and limits taken over."""
    rig = load_rig(write(tmp_path, GOOD))
    assert (rig.plate.length, rig.plate.width, rig.plate.thickness) == (0.3048, 0.2286, 0.0015)
    assert rig.plate.loss_factor == 0.01
    assert (rig.mesh.nx, rig.mesh.ny) == (48, 36)
    assert (rig.mesh.length, rig.mesh.width) == (0.3048, 0.2286)
    assert [era.name for era in rig.eras] == ["SW", "NE"]
    with pytest.raises(InputError):
        rig.era("X")
    north_east = rig.era("NE")
    assert (north_east.x, north_east.y) == (0.3048, 0.2286)
    assert (north_east.stiffness, north_east.bolt_mass, north_east.stroke) == (17000, 0, 1e-4)
    assert rig.era("SW").damping == 2.0
    with pytest.raises(InputError, match=r"'sww'; did you mean SW\? choose from SW, NE"):
        rig.era("sww")
    assert rig.wiring == {"SW": Channel("main", 0), "NE": Channel("main", 1)}
    assert rig.amplifiers == {"main": "sim://"}
    assert (rig.limits.frequency_min, rig.limits.frequency_max, rig.limits.level) == (40, 500, 0.5)


def test_load_rig_converts_damping_ratios(tmp_path: Path) -> None:
    """c = 2 zeta sqrt(k m / n), by hand: m = 2700 * 0.3048 * 0.2286 * 0.0015 kg, two ERAs."""
    rig = load_rig(write(tmp_path, GOOD.replace("damping: 2.0", "damping_ratio: 10 %")))
    mass = 2700 * 0.3048 * 0.2286 * 0.0015
    assert rig.era("SW").damping == pytest.approx(0.2 * math.sqrt(17000 * mass / 2), rel=1e-12)
    assert rig.era("NE").damping == pytest.approx(0.1 * math.sqrt(17000 * mass / 2), rel=1e-12)


def test_load_rig_reads_limits_over_time(tmp_path: Path) -> None:
    """2 % a millisecond is 20 a second, half a minute 30 s; what is not given is no limit."""
    text = GOOD + "  slew: 2 %/ms\n  power: 150 %\n  on_time: 0.5 min\n  duty: 25 %\n"
    limits = load_rig(write(tmp_path, text)).limits
    assert (limits.slew, limits.power, limits.on_time, limits.duty) == (20.0, 1.5, 30.0, 0.25)
    assert limits.rate == math.inf
    rate = load_rig(write(tmp_path, GOOD + "  rate: 0.1 kHz\n")).limits
    assert (rate.rate, rate.slew, rate.power, rate.on_time, rate.duty) == (100, *[math.inf] * 3, 1)


def test_load_rig_chooses_mesh_and_limits_when_missing(tmp_path: Path) -> None:
    """Without them the mesh is chosen for 500 Hz, which is the default limit."""
    without = "\n".join(line for line in GOOD.splitlines()[:20] if not line.startswith("mesh"))
    rig = load_rig(write(tmp_path, without))
    assert (rig.limits.frequency_min, rig.limits.frequency_max, rig.limits.level) == (40, 500, 1)
    with_them = GOOD.replace("mesh: 48x36", "mesh: auto")
    assert rig.mesh == load_rig(write(tmp_path, with_them)).mesh
    # D = E h^3 / 12 (1 - nu^2) = 22.0935 N m; wavelength = 2 pi (D / rho h w^2)^(1/4) = 0.1713 m
    assert rig.mesh.shortest_wavelength < 0.1713


def test_a_stiff_mount_says_how_large_it_is(tmp_path: Path) -> None:
    """From 1 MN/m `foot` is required; a point, said to be one, costs a warning with its size.

    Of 1.5 mm of aluminium a tenfold smaller point gives 11.1 nm/N: ln 10 / (2 pi 5/6 26.3 GPa h).
    """
    third = "  SE: {at: [12 in, 0], stiffness: 17 kN/m, amplifier: main, channel: 2}\namplifiers:"
    stiff = GOOD.replace("    stiffness: 17000\n", "    stiffness: 1 MN/m\n")
    stiff = stiff.replace("48x36", "auto").replace("amplifiers:", third)
    assert refused(tmp_path, stiff)[0][1] == "eras.NE.foot"
    for foot, warnings in (("0", 1), ("5 mm", 0)):
        text = stiff.replace("1 MN/m\n", f"1 MN/m\n    foot: {foot}\n")
        checked = RIG.check(read_document(write(tmp_path, text)))
        found = [each for each in checked.warnings if each.startswith("eras.NE.foot")]
        assert len(found) == warnings
        assert all("1.1 %" in each for each in found)


@pytest.mark.parametrize(
    ("gap", "warned"),
    [
        ("1.8 mm", None),
        ("1.6 mm", "10 %"),
        ("0.1 mm", "half of it or more"),
        ("0.5 mm, closed: true", None),
        ("0.2 mm, closed: true", "10 %"),
        ("0.05 mm, closed: true", "half of it or more"),
    ],
)
def test_check_warns_of_an_air_gap_whose_friction_couples_modes(
    tmp_path: Path, gap: str, warned: str | None
) -> None:
    """By boundary layers, by hand sqrt(2 1.82e-5 / (1.204 2 pi 40)) = 0.35 mm at 40 Hz."""
    text = LAMINATE.replace("  bond: full\n", f"  air_gap: {{depth: {gap}}}\n")
    text = text.replace("amplifiers:", "  SE: {at: [12 in, 0], stiffness: 17 kN/m}\namplifiers:")
    checked = RIG.check(read_document(write(tmp_path, text)))
    found = [each for each in checked.warnings if each.startswith("plate.air_gap")]
    assert len(found) == (warned is not None)
    assert all(f"off by {warned}" in each for each in found)


def test_check_warns_of_a_plate_as_thick_as_one_in_another_unit(tmp_path: Path) -> None:
    """6.4 cm in place of 6.4 mm of plywood, and no board of a shop."""
    text = GOOD.replace("48x36", "auto").replace("aluminium", "plywood")
    text = text.replace("amplifiers:", "  SE: {at: [12 in, 0], stiffness: 17 kN/m}\namplifiers:")
    for thickness, count in (("6.4 cm", 1), ("18 mm", 0)):
        path = write(tmp_path, text.replace("1.5 mm", thickness))
        warnings = RIG.check(read_document(path)).warnings
        assert sum(each.startswith("plate.thickness: 64 mm") for each in warnings) == count


def test_check_warns_of_layers_that_slide_within_the_frequencies(tmp_path: Path) -> None:
    """Aluminium 0.5 mm on both sides of 50 mm of foam of G 40 kPa: by hand 151 Hz.

    1.35 kg/m² of each face and a sixth of the foam's 2.5, since it turns about its middle:
    sqrt(2 x 40e3 / (0.05 x 1.767)) / 2 pi.
    """
    layers = """  layers:
    - {material: aluminium, thickness: 0.5 mm}
    - {material: {name: foam, E: MODULUS, rho: 50, nu: 0.25}, thickness: 50 mm}
    - {material: aluminium, thickness: 0.5 mm}
"""
    head, tail = LAMINATE[: LAMINATE.index("  layers:")], LAMINATE[LAMINATE.index("eras:") :]
    tail = tail.replace("amplifiers:", "  SE: {at: [12 in, 0], stiffness: 17 kN/m}\namplifiers:")
    for modulus, warned in (("0.1 MPa", True), ("100 MPa", False)):
        text = head + layers.replace("MODULUS", modulus) + tail
        checked = RIG.check(read_document(write(tmp_path, text)))
        found = [each for each in checked.warnings if each.startswith("plate.layers")]
        assert len(found) == warned
        assert all("at 15" in each and "above 7" in each for each in found)


def test_load_rig_reads_a_laminate(tmp_path: Path) -> None:
    """The plate has the stack's mass, by hand 2.7 + 0.2 + 2.38 kg/m², and the bond is read."""
    rig = load_rig(write(tmp_path, LAMINATE))
    assert rig.plate.mass == pytest.approx(5.28 * 0.3048 * 0.2286, rel=1e-9)
    assert rig.laminate is not None
    assert [layer.thickness for layer in rig.laminate.layers] == [1e-3, 0.2e-3, 2e-3]
    assert rig.laminate.bond == "full"
    assert rig.plate.laminate == rig.laminate
    firmer = load_rig(write(tmp_path, LAMINATE.replace("1 MPa", "10 MPa")))
    assert firmer.plate.flexural_rigidity > rig.plate.flexural_rigidity
    assert firmer.fingerprint != rig.fingerprint


def test_fingerprint_is_the_same_for_one_layer_and_a_plain_plate(tmp_path: Path) -> None:
    """A laminate of one layer has the numbers of that plate, and so its fingerprint."""
    one = GOOD.replace(
        "  thickness: 1.5 mm\n  material: aluminium",
        "  layers: [{material: aluminium, thickness: 1.5 mm}]",
    )
    assert load_rig(write(tmp_path, one)).fingerprint == load_rig(write(tmp_path, GOOD)).fingerprint


def test_load_rig_reads_masses_and_fingerprints_them(tmp_path: Path) -> None:
    """A mass is read with its unit; its name and order are no physics, its weight and place are."""
    bare = load_rig(write(tmp_path, GOOD))
    assert bare.masses == ()
    camera = "  camera: {at: [50 mm, 9 in], mass: 20 g}\n"
    plug = "  plug: {at: [0, 0], mass: 5 g}\n"
    rig = load_rig(write(tmp_path, GOOD + "masses:\n" + camera + plug))
    assert rig.masses == (PointLoad(0.05, 0.2286, mass=0.02), PointLoad(0.0, 0.0, mass=0.005))
    turned = (GOOD + "masses:\n" + plug + camera).replace("camera", "eye")
    assert load_rig(write(tmp_path, turned)).fingerprint == rig.fingerprint
    heavier = load_rig(
        write(tmp_path, (GOOD + "masses:\n" + camera + plug).replace("20 g", "21 g"))
    )
    assert len({bare.fingerprint, rig.fingerprint, heavier.fingerprint}) == 3


def test_load_rig_reads_uncertainty(tmp_path: Path) -> None:
    """A key left out has the value of a plate that was not measured; 0, or a factor 1, is exact."""
    built = Uncertainty(
        gain=0.05, phase_deg=5, thickness=0.02, stiffness=0.1, damping=1.5, fingertip=0.5
    )
    for empty in ("", "uncertainty: {}\n"):
        assert load_rig(write(tmp_path, GOOD + empty)).uncertainty == built
    known = load_rig(write(tmp_path, GOOD + "uncertainty: {gain: 1 %, damping: 1, thickness: 0}\n"))
    assert known.uncertainty == Uncertainty(0.01, 5.0, 0.0, 0.1, 1.0, 0.5)
    assert known.uncertainty.exactly_known == ("thickness", "damping")
    for wrong in ("damping: 0.5", "thickness: 0.1", "gain: -0.1", "mass: 1"):
        with pytest.raises(ConfigError):
            load_rig(write(tmp_path, GOOD + f"uncertainty: {{{wrong}}}\n"))


def test_load_rig_reads_fingertip_and_threshold(tmp_path: Path) -> None:
    """A finger that presses lightly by default, one by its values, or none; all are answers'."""
    light = load_rig(write(tmp_path, GOOD))
    assert light.fingertip == Fingertip(1000, 2, 0.0002, 0.005, 500, 2)
    firm = load_rig(write(tmp_path, GOOD + "fingertip: {stiffness: 2 kN/m, contact_mass: 0.3 g}\n"))
    assert firm.fingertip == Fingertip(2000, 2, 0.0003, 0.005, 500, 2)
    none = load_rig(write(tmp_path, GOOD + "fingertip: none\n"))
    assert none.fingertip is None
    known = load_rig(write(tmp_path, GOOD + "uncertainty: {field: 0.1}\n"))
    assert len({rig.fingerprint for rig in (light, firm, none, known)}) == 4
    for wrong in ("fingertip: heavy", "fingertip: {damping: 0}", "threshold: loud"):
        with pytest.raises(ConfigError):
            load_rig(write(tmp_path, GOOD + wrong + "\n"))


def test_load_rig_moves_an_era_within_rounding_onto_the_edge(tmp_path: Path) -> None:
    """What arithmetic adds to a corner's coordinate is taken off again."""
    rig = load_rig(write(tmp_path, GOOD.replace("[0.3048,", "[0.30480000000000007,")))
    assert rig.era("NE").x == 0.3048


def test_config_check_refuses_an_unsupported_plate(tmp_path: Path) -> None:
    """Two ERAs let the plate tip over; such a rig loads, so that a study can start from it."""
    path = write(tmp_path, GOOD)
    assert len(load_rig(path).eras) == 2
    with pytest.raises(ConfigError) as caught:
        RIG.check(read_document(path))
    assert [(each.line, each.key) for each in caught.value.problems] == [(7, "eras")]


def test_uncertainty_is_shown_to_three_digits() -> None:
    """What an identification leaves uncertain has no digits in a report beyond those known."""
    shown = str(Uncertainty(gain=0.0101507, phase_deg=1.00303, damping=1.03340))
    assert shown == (
        "gain 1.02 %, thickness 2 %, modulus 2 %, stiffness 10 %, harmonic 1 %, phase 1°, "
        "damping x 1.033, fingertip x 1.6, place 1 mm"
    )
