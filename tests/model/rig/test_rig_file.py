import math
from collections.abc import Callable
from pathlib import Path

import pytest

from model.config.document import ConfigError, read_document
from model.errors import InputError
from model.rig.rig import Channel, Rig, Uncertainty
from model.rig.rig_file import load_rig, parse_mesh
from model.rig.rig_summary import RIG
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
FEET = "supports:\n  a: {at: [0, 0], stiffness: 3000}\n"
TAPE = "supports:\n  a: {along: edges, stiffness_per_length: 3000}\n"
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
        ((12, 18), "  NE: {at: [12 in, 9 in], stiffness: 17000}", "7 eras"),
        ((7, 18), "", "1 eras"),
        (9, "    at: [0, 0, 0]", "9 eras.SW.at"),
        (9, "    at: [0]", "9 eras.SW.at[1]"),
        (9, "    at: [0, 1 kg]", "9 eras.SW.at[1]"),
        (9, "    at: [0, 9.1 in]", "9 eras.SW.at"),
        (9, "    at: [-1 mm, 0]", "9 eras.SW.at"),
        (10, "    stiffness: 17 N", "10 eras.SW.stiffness"),
        (10, "", "8 eras.SW.stiffness"),
        (11, "    stroke: 100", "11 eras.SW.stroke"),
        (11, "    gains: [[50, 0.9, 90], [60, 0, 0]]", "11 eras.SW.gains"),
        (11, "    gains: [[50, 0.9, 90], [40, 1, 0]]", "11 eras.SW.gains"),
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
        (10, "    stiffness: 1 MN/m", "8 eras.SW.foot"),
        (23, "  level: 0.5\nuncertainty: {damping: 0.5}", "24 uncertainty.damping"),
        (23, "  level: 0.5\nuncertainty: {thickness: 0.1}", "24 uncertainty.thickness"),
        (23, "  level: 0.5\nuncertainty: {gain: -0.1}", "24 uncertainty.gain"),
        (23, "  level: 0.5\nuncertainty: {mass: 1}", "24 uncertainty.mass"),
        (23, "  level: 0.5\nfingertip: heavy", "24 fingertip"),
        (23, "  level: 0.5\nfingertip: {damping: 0}", "24 fingertip.damping"),
        (23, "  level: 0.5\nthreshold: loud", "24 threshold"),
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


CAMERA, PLUG = "camera: {at: [50 mm, 9 in], mass: 20 g}", "plug: {at: [0, 0], mass: 5 g}"
RATIO = 2 * math.sqrt(17000 * 2700 * 0.3048 * 0.2286 * 0.0015 / 2)  # c = zeta 2 sqrt(k m / n)
OVER_TIME = "  slew: 2 %/ms\n  power: 150 %\n  on_time: 0.5 min\n  duty: 25 %\n"
FIRM = "fingertip: {stiffness: 2 kN/m, contact_mass: 0.3 g}\n"
ONE_LAYER = GOOD.replace(
    "  thickness: 1.5 mm\n  material: aluminium",
    "  layers: [{material: aluminium, thickness: 1.5 mm}]",
)
UNMESHED = "\n".join(line for line in GOOD.splitlines()[:20] if not line.startswith("mesh"))


@pytest.mark.parametrize(
    ("text", "read", "expected"),
    [
        (
            GOOD,
            lambda rig: (rig.plate.length, rig.plate.width, rig.plate.thickness),
            (0.3048, 0.2286, 0.0015),
        ),
        (GOOD, lambda rig: (rig.plate.loss_factor, rig.mesh.nx, rig.mesh.ny), (0.01, 48, 36)),
        (GOOD, lambda rig: (rig.mesh.length, rig.mesh.width), (0.3048, 0.2286)),
        (
            GOOD,
            lambda rig: (rig.eras[0].name, rig.eras[0].damping, rig.eras[1].name),
            ("SW", 2.0, "NE"),
        ),
        (
            GOOD,
            lambda rig: (rig.eras[1].x, rig.eras[1].y, rig.eras[1].stiffness),
            (0.3048, 0.2286, 17000),
        ),
        (GOOD, lambda rig: (rig.eras[1].bolt_mass, rig.eras[1].stroke, rig.masses), (0, 1e-4, ())),
        (GOOD, lambda rig: (rig.wiring,), ({"SW": Channel("main", 0), "NE": Channel("main", 1)},)),
        (GOOD, lambda rig: (rig.amplifiers,), ({"main": "sim://"},)),
        (
            GOOD,
            lambda rig: (rig.limits.frequency_min, rig.limits.frequency_max, rig.limits.level),
            (40, 500, 0.5),
        ),
        # what arithmetic adds to a corner's coordinate is taken off again
        (
            GOOD.replace("[0.3048,", "[0.30480000000000007,"),
            lambda rig: (rig.eras[1].x,),
            (0.3048,),
        ),
        (
            GOOD.replace("damping: 2.0", "gains: [[50, 0.9, 90], [60, 1, 0]]"),
            lambda rig: (rig.eras[0].gains, rig.eras[1].gains),
            (((50.0, 0.9, math.pi / 2), (60.0, 1.0, 0.0)), ()),
        ),
        (
            GOOD.replace("damping: 2.0", "damping_ratio: 10 %"),
            lambda rig: (rig.eras[0].damping, rig.eras[1].damping),
            (pytest.approx(0.1 * RATIO, rel=1e-12), pytest.approx(0.05 * RATIO, rel=1e-12)),
        ),
        (
            GOOD + OVER_TIME,
            lambda rig: (
                rig.limits.slew,
                rig.limits.power,
                rig.limits.on_time,
                rig.limits.duty,
                rig.limits.rate,
            ),
            (20.0, 1.5, 30.0, 0.25, math.inf),
        ),
        (
            GOOD + "  rate: 0.1 kHz\n",
            lambda rig: (rig.limits.rate, rig.limits.slew, rig.limits.duty),
            (100, math.inf, 1),
        ),
        (
            UNMESHED,
            lambda rig: (rig.limits.frequency_min, rig.limits.frequency_max, rig.limits.level),
            (40, 500, 1),
        ),
        # by hand 2.7 + 0.2 + 2.38 kg/m²
        (
            LAMINATE,
            lambda rig: (rig.plate.mass,),
            (pytest.approx(5.28 * 0.3048 * 0.2286, rel=1e-9),),
        ),
        (
            LAMINATE,
            lambda rig: (rig.laminate.thickness, rig.laminate.bond),
            (pytest.approx(3.2e-3), "full"),
        ),
        (
            f"{GOOD}masses:\n  {CAMERA}\n  {PLUG}\n",
            lambda rig: (rig.masses,),
            ((PointLoad(0.05, 0.2286, mass=0.02), PointLoad(0.0, 0.0, mass=0.005)),),
        ),
        # of a plate that was not measured; 0, or a factor 1, is exact
        (GOOD, lambda rig: (rig.uncertainty,), (Uncertainty(0.05, 5.0, 0.02, 0.1, 1.5, 0.5),)),
        (GOOD + "uncertainty: {}\n", lambda rig: (rig.uncertainty,), (Uncertainty(),)),
        (
            GOOD + "uncertainty: {gain: 1 %, damping: 1, thickness: 0}\n",
            lambda rig: (rig.uncertainty, rig.exactly_known),
            (Uncertainty(0.01, 5.0, 0.0, 0.1, 1.0, 0.5), ("thickness", "damping")),
        ),
        # feet are known as little by their stiffness as by their kind, those of edges are none
        (GOOD + FEET, lambda rig: (rig.uncertainty.supports, rig.exactly_known), (0.3, ())),
        (GOOD + TAPE, lambda rig: (rig.uncertainty.supports, rig.exactly_known), (0.0, ())),
        (
            GOOD + FEET + "uncertainty: {supports: 0}\n",
            lambda rig: (rig.uncertainty.supports, rig.exactly_known),
            (0.0, ("supports",)),
        ),
        (GOOD, lambda rig: (rig.fingertip,), (Fingertip(1000, 2, 0.0002, 0.005, 500, 2),)),
        (GOOD + FIRM, lambda rig: (rig.fingertip,), (Fingertip(2000, 2, 0.0003, 0.005, 500, 2),)),
        (GOOD + "fingertip: none\n", lambda rig: (rig.fingertip,), (None,)),
    ],
)
def test_load_rig_reads_what_a_file_says(
    tmp_path: Path, text: str, read: Callable[[Rig], object], expected: object
) -> None:
    """Units are converted, defaults filled in, wiring and limits taken over."""
    assert read(load_rig(write(tmp_path, text))) == expected


def test_an_unknown_era_is_named_with_what_was_meant(tmp_path: Path) -> None:
    """By the names that there are."""
    with pytest.raises(InputError, match=r"'sww'; did you mean SW\? choose from SW, NE"):
        load_rig(write(tmp_path, GOOD)).era("sww")


def test_load_rig_chooses_a_mesh_when_missing(tmp_path: Path) -> None:
    """It is chosen for 500 Hz, which is the default limit."""
    rig = load_rig(write(tmp_path, UNMESHED))
    with_it = GOOD.replace("mesh: 48x36", "mesh: auto")
    assert rig.mesh == load_rig(write(tmp_path, with_it)).mesh
    # D = E h^3 / 12 (1 - nu^2) = 22.0935 N m; wavelength = 2 pi (D / rho h w^2)^(1/4) = 0.1713 m
    assert rig.mesh.shortest_wavelength < 0.1713


@pytest.mark.parametrize(
    ("one", "other"),
    [
        (GOOD, ONE_LAYER),
        (
            f"{GOOD}masses:\n  {CAMERA}\n  {PLUG}\n",
            f"{GOOD}masses:\n  {PLUG}\n  {CAMERA.replace('camera', 'eye')}\n",
        ),
    ],
    ids=["a single layer", "names and order of masses"],
)
def test_what_is_no_physics_leaves_the_fingerprint(tmp_path: Path, one: str, other: str) -> None:
    """A laminate of one layer is that plate, a mass by another name is that mass."""
    found = [load_rig(write(tmp_path, text)).fingerprint for text in (one, other)]
    assert found[0] == found[1]


THIRD = "  SE: {at: [12 in, 0], stiffness: 17 kN/m, amplifier: main, channel: 2}\namplifiers:"
STIFF = GOOD.replace("    stiffness: 17000\n", "    stiffness: 1 MN/m\n    foot: FOOT\n")
GAP = LAMINATE.replace("  bond: full\n", "  air_gap: {depth: GAP}\n")
THICK = GOOD.replace("aluminium", "plywood")
FOAM = """  layers:
    - {material: aluminium, thickness: 0.5 mm}
    - {material: {name: foam, E: MODULUS, rho: 50, nu: 0.25}, thickness: 50 mm}
    - {material: aluminium, thickness: 0.5 mm}
"""
FOAMED = LAMINATE[: LAMINATE.index("  layers:")] + FOAM + LAMINATE[LAMINATE.index("mesh:") :]


@pytest.mark.parametrize(
    ("text", "key", "said"),
    [
        # Of 1.5 mm of aluminium a tenfold smaller point gives 11.1 nm/N: ln 10 / (2 pi 5/6 G h).
        (STIFF.replace("FOOT", "0"), "eras.NE.foot", "1.1 %"),
        (STIFF.replace("FOOT", "5 mm"), "eras.NE.foot", None),
        # By boundary layers, by hand sqrt(2 1.82e-5 / (1.204 2 pi 40)) = 0.35 mm at 40 Hz.
        (GAP.replace("GAP", "1.8 mm"), "plate.air_gap", None),
        (GAP.replace("GAP", "1.6 mm"), "plate.air_gap", "off by 10 %"),
        (GAP.replace("GAP", "0.1 mm"), "plate.air_gap", "off by half of it or more"),
        (GAP.replace("GAP", "0.5 mm, closed: true"), "plate.air_gap", None),
        (GAP.replace("GAP", "0.2 mm, closed: true"), "plate.air_gap", "off by 10 %"),
        (GAP.replace("GAP", "0.05 mm, closed: true"), "plate.air_gap", "off by half of it"),
        # 6.4 cm in place of 6.4 mm of plywood, and no board of a shop.
        (THICK.replace("1.5 mm", "6.4 cm"), "plate.thickness", "64 mm"),
        (THICK.replace("1.5 mm", "18 mm"), "plate.thickness", None),
        # By hand 151 Hz of foam of G 40 kPa: 1.35 kg/m² of each face and a sixth of the foam's 2.5,
        # since it turns about its middle: sqrt(2 x 40e3 / (0.05 x 1.767)) / 2 pi.
        (FOAMED.replace("MODULUS", "0.1 MPa"), "plate.layers", "at 151 Hz"),
        (FOAMED.replace("MODULUS", "0.1 MPa"), "plate.layers", "above 75"),
        (FOAMED.replace("MODULUS", "100 MPa"), "plate.layers", None),
    ],
)
def test_check_warns_of_what_costs_accuracy(
    tmp_path: Path, text: str, key: str, said: str | None
) -> None:
    """Of stiff points, of friction in an air gap, of another unit, of layers that slide."""
    text = text.replace("48x36", "auto").replace("amplifiers:", THIRD)
    warnings = RIG.check(read_document(write(tmp_path, text))).warnings
    found = [each for each in warnings if each.startswith(key)]
    assert len(found) == (said is not None)
    assert all(str(said) in each for each in found)


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
