"""Rig files, read and written again with other values.

Full levels, gains of ERAs and layouts; text with the values of a fitted rig.
"""

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from paper_figures import diagonal_pair, edge_pair

from controller.rig_file_check import check_rig
from era_haptics.command import run_era
from kit.direct_plate import direct_acceleration
from kit.plates import exciter_rig, exciter_rig_text
from kit.set_table import only
from model.answer.stimulus import Placement
from model.config.document import ConfigError, KeyPath, read_document
from model.errors import InputError
from model.fem import assemble
from model.reduction.free_plate import solve_free_plate
from model.rig import rig_writing
from model.rig.era_layouts import FOUR_ERA_LAYOUTS
from model.rig.rig import Channel, Rig, Uncertainty
from model.rig.rig_file import load_rig, parse_rig
from model.rig.rig_mesh import parse_mesh
from model.rig.rig_warnings import gain_notes
from model.rig.rig_writing import (
    fitted_keys,
    save_beside,
    save_fitted,
    save_rig,
)
from model.rig.sections import MassSection, SupportSection
from model.structure.attachments import PointLoad
from model.structure.fingertips import Fingertip
from model.table.table_file import build_table

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


INVALID: dict[str, list[tuple[int | tuple[int, int], str, str]]] = {
    GOOD: [
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
    LAMINATE: [
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
}
"""Of a good rig: lines that are replaced, by what, and `LINE key, suggestion` of a problem."""


@pytest.mark.parametrize(
    ("good", "lines", "text", "where"),
    [(good, *row) for good, rows in INVALID.items() for row in rows],
    ids=[where for rows in INVALID.values() for *_, where in rows],
)
def test_load_rig_refuses_an_invalid_value_with_line_and_key(
    tmp_path: Path, good: str, lines: int | tuple[int, int], text: str, where: str
) -> None:
    """Each kind of value, section and reference is checked; a mistyped name gets a suggestion.

    Of a laminate the key leads to the layer that is wrong.
    """
    first, last = lines if isinstance(lines, tuple) else (lines, lines)
    rows = good.splitlines()
    rows[first - 1 : last] = text.splitlines()
    place, _, suggestion = where.partition(", ")
    with pytest.raises(ConfigError) as caught:
        load_rig(write(tmp_path, "\n".join(rows)))
    assert any(
        f"{each.line} {each.key}" == place
        and f"did you mean {suggestion}?" in f"{each.message}did you mean ?"
        for each in caught.value.problems
    )


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
        pytest.param(
            GOOD + FEET,
            lambda rig: (rig.uncertainty.supports, rig.exactly_known),
            (0.3, ()),
            id="feet of a stated stiffness",
        ),
        (GOOD + TAPE, lambda rig: (rig.uncertainty.supports, rig.exactly_known), (0.0, ())),
        pytest.param(
            GOOD + FEET + "uncertainty: {supports: 0}\n",
            lambda rig: (rig.uncertainty.supports, rig.exactly_known),
            (0.0, ("supports",)),
            id="feet that are known exactly",
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


def test_load_rig_chooses_a_mesh_when_missing(tmp_path: Path) -> None:
    """It is chosen for 500 Hz, which is the default limit; one is written in common spellings.

    An unknown ERA is named with what was meant, by the names that there are.
    """
    rig = load_rig(write(tmp_path, UNMESHED))
    with_it = GOOD.replace("mesh: 48x36", "mesh: auto")
    assert rig.mesh == load_rig(write(tmp_path, with_it)).mesh
    # D = E h^3 / 12 (1 - nu^2) = 22.0935 N m; wavelength = 2 pi (D / rho h w^2)^(1/4) = 0.1713 m
    assert rig.mesh.shortest_wavelength < 0.1713
    for text in ("48x36", "48X36", " 48 x 36 ", "48×36"):
        mesh = parse_mesh(text, rig.plate)
        assert (mesh.nx, mesh.ny, mesh.length, mesh.width) == (48, 36, 0.3048, 0.2286)
    with pytest.raises(InputError, match=r"'sww'; did you mean SW\? choose from SW, NE"):
        rig.era("sww")


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
        (GAP.replace("GAP", "0.1 mm"), "plate.air_gap", "off by 50 % or more"),
        (GAP.replace("GAP", "0.5 mm, closed: true"), "plate.air_gap", None),
        (GAP.replace("GAP", "0.2 mm, closed: true"), "plate.air_gap", "off by 10 %"),
        (GAP.replace("GAP", "0.05 mm, closed: true"), "plate.air_gap", "off by 50 %"),
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
    """Of stiff points, of friction in an air gap, of another unit, of layers that slide.

    Two ERAs let the plate tip over, which is refused; such a rig loads, so that a study can start
    from it.
    """
    path = write(tmp_path, text.replace("48x36", "auto"))
    assert len(load_rig(path).eras) == 2
    with pytest.raises(ConfigError, match=r":\d+: eras: "):
        check_rig(read_document(path))
    write(tmp_path, path.read_text("utf-8").replace("amplifiers:", THIRD))
    warnings = check_rig(read_document(path)).warnings
    found = [each for each in warnings if each.startswith(key)]
    assert len(found) == (said is not None)
    assert all(str(said) in each for each in found)


@pytest.mark.parametrize(
    ("material", "keys", "change"),
    [
        # by hand: 0.4 % a kelvin for 15 K; 1.5 % and the share of mass for 2 % of moisture
        ("acrylic", "temperature: [73.4 degF, 311.15 K]; measured_temperature: 23 °C", 0.06),
        ("plywood", "humidity: [50 %, 61 %]; measured_humidity: 50 %", 0.02 * (1.5 + 1 / 1.12)),
        ("{name: plywood, E: 8 GPa, nu: 0.3, rho: 700}", "humidity: [0.5, 0.65]", 0.067),
        ("{E: 8 GPa, nu: 0.3, rho: 700}", "humidity: [50 %, 70 %]", 0.0),
        ("acrylic", "measured_temperature: 35 °C", 0.0),
    ],
    ids=["acrylic", "plywood", "by name", "by numbers", "not stated"],
)
def test_weather_is_an_uncertainty_of_what_was_measured(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], material: str, keys: str, change: float
) -> None:
    """0.8 of the largest change, also where the thickness is known; a check says what it costs."""
    of_plate = "\n  ".join([f"material: {material}", *keys.split("; ")])
    text = GOOD.replace("material: aluminium", of_plate).replace("48x36", "auto")
    known = parse_rig("rig", text + "uncertainty: {thickness: 0}\n").uncertainty
    assert 2 * known.frequency == pytest.approx(0.8 * change, rel=0.01)
    assert parse_rig("rig", text + "uncertainty: {weather: 0.01}\n").uncertainty.weather == 0.01
    on_feet = text + FEET.replace("[0, 0]", "[0, 228.6 mm]")
    assert run_era(["config", "check", str(write(tmp_path, on_feet))]) == 0
    said = capsys.readouterr().out
    assert ("change its modulus by" in said) == (change > 0)
    assert ("nothing is known" in said) == ("humidity" in keys and not change)


def test_uncertainty_is_shown_to_three_digits() -> None:
    """What an identification leaves uncertain has no digits in a report beyond those known."""
    shown = str(Uncertainty(gain=0.0101507, phase_deg=1.00303, damping=1.03340))
    assert shown == (
        "gain 1.02 %, thickness 2 %, modulus 2 %, stiffness 10 %, harmonic 1 %, phase 1°, "
        "damping x 1.033, fingertip x 1.6, place 1 mm"
    )


RIG_TEXT = """
plate: {length: 12 in, width: 9 in, thickness: 1.5 mm, material: aluminium}
mesh: 16x12
eras:
  SW: {at: [0, 0], stiffness: 17000, amplifier: main, channel: 0}
  SE: {at: [12 in, 0], stiffness: 17000, amplifier: main, channel: 1, gains: {SE}}
  NE: {at: [12 in, 9 in], stiffness: 17000}
  NW: {at: [0, 9 in], stiffness: 17000}
amplifiers:
  main: {url: "sim://", full_level: {main}}
limits: {frequency: [60, 260]}
"""


def text(*, full_level: str = "output", gains: str = "[[40, 6, 0], [300, 2, -20]]") -> str:
    """The rig with this full level and these gains of one ERA."""
    return RIG_TEXT.replace("{main}", full_level).replace("{SE}", gains)


def test_full_level_is_a_motion_or_an_output() -> None:
    """A motion unless the file says that it is an output, as that of the desk does.

    What drives exciters is one without a word.
    """
    assert parse_rig("rig.yaml", text().replace(", full_level: output", "")).outputs == set()
    assert parse_rig("rig.yaml", text(full_level="motion")).outputs == set()
    assert parse_rig("rig.yaml", text()).outputs == {"main"}
    assert load_rig(RIG).outputs == {"main"}
    board = exciter_rig_text().replace(", full_level: output", "")
    assert "full_level" not in board
    assert parse_rig("board.yaml", board).outputs == {"card"}
    with pytest.raises(ConfigError, match=r"amplifiers\.main\.full_level"):
        parse_rig("rig.yaml", text(full_level="voltage"))


def test_check_says_which_motion_by_an_output_is_a_guess() -> None:
    """Of the ERAs without gains at once; of motions and exciters nothing is to be measured.

    Halfway between rows 90 degrees apart a straight line has 0.7 of the gain; 179 to -176 is 5.
    Rows beyond the limits of frequency are not played.
    """
    (guess,) = gain_notes(parse_rig("rig.yaml", text()))
    assert guess.startswith("gains of SW: missing")
    both = text().replace(", gains: [[40, 6, 0], [300, 2, -20]]", "")
    assert gain_notes(parse_rig("rig.yaml", both)) == [guess.replace("SW", "SW, SE")]
    assert gain_notes(exciter_rig()) == []
    assert gain_notes(parse_rig("rig.yaml", text(full_level="motion"))) == []
    far = "[[40, 2, 179], [150, 2, -176], [255, 2, 94], [300, 2, 90], [320, 2, 0]]"
    _, coarse = gain_notes(parse_rig("rig.yaml", text(gains=far)))
    assert coarse.startswith("eras.SE.gains: phases differ by 90 degrees between 150 and 255 Hz")


@pytest.mark.parametrize(
    ("section", "key"),
    [
        (MassSection(at=[0.1, 0.1]), "mass"),
        (MassSection(along="edges"), "mass_per_length"),
        (SupportSection(at=[0.1, 0.1]), "stiffness"),
        (SupportSection(along="edges"), "stiffness_per_length"),
    ],
)
def test_section_without_a_required_key_is_not_built(
    section: MassSection | SupportSection, key: str
) -> None:
    """No mass and no stiffness is assumed where a file was not checked."""
    with pytest.raises(InputError, match=f"^{key}: missing"):
        section.build(parse_rig("rig.yaml", text()).plate)


def test_era_without_amplifier_supports_as_one_at_rest() -> None:
    """Fields of the others are those of the rig in which it is wired and not driven.

    No pattern drives it.
    """
    rig = parse_rig("rig.yaml", text())
    wired = text().replace("17000}", "17000, amplifier: side, channel: 0}", 1)
    wired = wired.replace("17000}", "17000, amplifier: side, channel: 1}", 1)
    whole = parse_rig("rig.yaml", wired.replace("limits", '  side: {url: "sim://x"}\nlimits'))
    assert (rig.supports, [era.name for era in rig.eras]) == (("NE", "NW"), ["SW", "SE"])
    frequencies, points = np.array([80.0, 220.0]), np.array([[0.1, 0.06], [0.22, 0.16]])

    def fields(one: Rig) -> np.ndarray:
        plate = assemble(one.plate, one.mesh)
        return direct_acceleration(plate, one.eras, frequencies, points, loads=one.masses)

    np.testing.assert_allclose(fields(rig), fields(whole)[:, :2], rtol=1e-9)
    table = build_table(rig, frequencies=np.arange(60.0, 261.0, 20.0))
    np.testing.assert_allclose(
        table.unit_fields(points)[[1, 8]],
        fields(rig),
        rtol=0.02,
        atol=0.02 * np.abs(fields(rig)).max(),
    )
    placed = Placement(((0.1, 0.06),), ((0.22, 0.16),))
    layer, _ = only(table, placed, 10.0, drive_mode="phased")
    assert set(layer.excitation) <= {"SW", "SE"}


GAINS = ((100.0, 0.9, 0.2), (200.0, 1.3, -0.4))


@pytest.fixture
def uneven(coarse_rig: Rig) -> Rig:
    """The paper's plate, its second ERA with gains."""
    eras = list(coarse_rig.eras)
    eras[1] = replace(eras[1], gains=GAINS)
    return replace(coarse_rig, eras=tuple(eras))


def test_era_gain_is_interpolated_and_held_beyond_its_frequencies(
    coarse_rig: Rig, uneven: Rig
) -> None:
    """It lies on the line between two complex gains, and is the last one beyond.

    The ERA's own response is multiplied, not its neighbors'.
    """
    low, high = 0.9 * np.exp(0.2j), 1.3 * np.exp(-0.4j)
    frequencies, points = np.array([50.0, 100.0, 125.0, 300.0]), np.array([[0.1, 0.05], [0.2, 0.2]])
    found = uneven.eras[1].gain(frequencies)
    np.testing.assert_allclose(found, [low, low, 0.75 * low + 0.25 * high, high])
    factor = np.ones((4, 4, 1), dtype=complex)
    factor[:, 1, 0] = found
    free = solve_free_plate(coarse_rig.plate, coarse_rig.mesh)
    scaled, plain = (
        free.acceleration(each.eras, frequencies, points) for each in (uneven, coarse_rig)
    )
    np.testing.assert_allclose(scaled, factor * plain, rtol=1e-10)


def test_corners_and_pairs_are_those_of_the_paper(coarse_rig: Rig) -> None:
    """`corners` are its own rig, of which SW and SE share the long edge, and SW and NE not."""
    eras = coarse_rig.eras
    corners = next(layout for layout in FOUR_ERA_LAYOUTS if layout.name == "corners")
    expected = [(era.x, era.y) for era in eras]
    np.testing.assert_allclose(corners.positions(coarse_rig.plate), expected)
    pairs = [[eras[era].name for era in of(eras)] for of in (edge_pair, diagonal_pair)]
    assert pairs == [["SW", "SE"], ["SW", "NE"]]


RIG = Path(__file__).parents[3] / "examples" / "desk" / "rig.yaml"

FLOW = """\
# my panel
plate: {length: 0.3, width: 0.2, thickness: 2 mm, material: steel}  # from stock
mesh: 12x9
limits: {frequency: [40, 200]}
eras:
  A: {at: [0, 0], stiffness: 9 kN/m, damping_ratio: 0.1, amplifier: m, channel: 0}
  B: {at: [0.3, 0], stiffness: 9000, amplifier: m, channel: 1, }
  C: {at: [0, 0.2], stiffness: 9000, damping: 2, bolt_mass: 3 g, amplifier: m, channel: 2}
amplifiers: {m: {url: "sim://"}}
"""

BLOCK = """\
plate:
  length: 0.3
  width: 0.2
  layers:   # glass on glass
    - material: soda-lime-glass
      thickness: 2 mm
    - material: {E: 60 GPa, rho: 2500, nu: 0.2}
      thickness: 1 mm   # the touch side
  bond: none
  loss_factor: 2 %   # bonded
mesh: 12x9
limits: {frequency: [40, 200]}
eras:
  A:   # "ä" in a comment: µ
    at:
      - 0
      - 0
    stiffness: 9000   # maker's
    amplifier: m
    channel: 0
    gains:
      - [50, 1, 0]
      - [60, 1, 0]
  B:
    at: [0.3, 0]
    bolt_mass: 1 g
    stiffness: 9000
    amplifier: m
    channel: 1
  C: {at: [0, 0.2], stiffness: 9000, amplifier: m, channel: 2}
amplifiers: {m: {url: "sim://"}}
"""

REWRITTEN_BOARD = (
    FLOW.replace("thickness: 2 mm, material: steel", "thickness: 6 mm, material: plywood")
    .replace("width: 0.2,", "width: 0.2, grain: width,")
    .replace("mesh: 12x9", "supports: {foot: {at: [0.1, 0.1], kind: foam}}  # of foam")
)

BY_NUMBERS = REWRITTEN_BOARD.replace(
    "plywood", "{E1: 12 GPa, E2: 4.8 GPa, G12: 0.7 GPa, G13: 350 MPa, G23: 250 MPa, nu12: 0.05, "
    "rho: 680}",
)  # fmt: skip

ACRYLIC = REWRITTEN_BOARD.replace("plywood", "acrylic")

BONDED = BLOCK.replace("bond: none", "bond: full").replace("12x9", "auto")


def other_values(rig: Rig) -> Rig:
    """Other values everywhere, gains for all but the last ERA."""
    plate = replace(rig.plate.scaled(modulus=1.2345678), loss_factor=0.0234)
    eras = tuple(
        replace(
            era,
            stiffness=era.stiffness * 1.1 + number,
            damping=era.damping + 1.5,
            bolt_mass=era.bolt_mass + 0.0123456,
            x=0.00123 if number == 0 else era.x,
            gains=((50.0, 0.91234, -0.2), (60.5, 1.1, 3.0)) if number < 2 else (),
        )
        for number, era in enumerate(rig.eras)
    )
    return replace(
        rig,
        plate=plate,
        laminate=rig.laminate and rig.laminate.scaled(modulus=1.2345678),
        eras=eras,
        uncertainty=Uncertainty(0.004, 0.3, 0.002, 0.01, 1.02, 0.5),
    )


TEXTS = {
    "flow": FLOW,
    "block": BLOCK,
    "bonded": BONDED,
    "board": REWRITTEN_BOARD,
    "by numbers": BY_NUMBERS,
    "acrylic": ACRYLIC,
}


def fitted(
    folder: Path,
    text: str,
    change: Callable[[Rig], Rig],
    errors: Mapping[KeyPath, float] | None = None,
) -> tuple[Rig, Rig, Path]:
    """A rig of a file in a folder, what a fit made of it, and the file that was written beside."""
    file, output = folder / "rig.yaml", folder / "rig.fitted.yaml"
    file.write_text(text, "utf-8")
    rig = load_rig(file)
    after = change(rig)
    save_fitted(output, rig, after, comment="new\nvalues", errors=errors)
    assert file.read_text("utf-8") == text
    return rig, after, output


@pytest.mark.parametrize("text", TEXTS.values(), ids=TEXTS)
def test_what_a_fit_found_stands_beside_the_rig_and_is_read_in_its_place(
    text: str, tmp_path: Path
) -> None:
    """Values are those of the other rig, layers' moduli too, also once both are merged."""
    rig, other, output = fitted(tmp_path, text, other_values)
    assert output.read_text("utf-8").startswith("# new\n# values\n\nbase: rig.yaml\n")
    save_rig(load_rig(output), tmp_path / "whole.yaml")
    for back in (load_rig(output), load_rig(tmp_path / "whole.yaml")):
        if back.plate.laminate is None or "layers:" not in text:
            before, after = (
                each.laminate.layers[0].material if each.laminate else each.plate.material
                for each in (rig, back)
            )
            expected = {key: 1.2345678 * each for key, each in before.moduli.items()}
            assert after.moduli == pytest.approx(expected, rel=1e-12)
        else:
            moduli = [layer.material.E for layer in back.plate.laminate.layers]
            assert moduli == pytest.approx([1.2345678 * 70e9, 1.2345678 * 60e9], rel=1e-12)
        assert back.plate.loss_factor == 0.0234
        for era, found in zip(back.eras, other.eras, strict=True):
            assert (era.stiffness, era.bolt_mass) == (found.stiffness, found.bolt_mass)
            assert era.damping == pytest.approx(found.damping, rel=1e-12)
            np.testing.assert_allclose(era.gains, found.gains, rtol=1e-12)
        assert back.wiring == rig.wiring
        assert back.limits == rig.limits
        assert back.uncertainty == other.uncertainty
        assert back.plate.mass == pytest.approx(rig.plate.mass, rel=1e-9)


def test_a_fit_of_a_fitted_rig_keeps_the_first_base(tmp_path: Path) -> None:
    """Channels found first and stiffness found later stand in one file beside the first one."""
    file, wired = tmp_path / "rig.yaml", tmp_path / "wired.yaml"
    file.write_text(FLOW, "utf-8")
    document = load_rig(file).document
    assert document is not None
    keys = {"eras": {"A": {"channel": 1}, "B": {"channel": 0}}}
    rig = save_beside(wired, document, keys, comment="wired")
    after = replace(rig, eras=tuple(replace(era, stiffness=8e3) for era in rig.eras))
    save_fitted(tmp_path / "both.yaml", load_rig(wired), after, comment="fitted")
    back = load_rig(tmp_path / "both.yaml")
    assert [back.wiring[name].number for name in "ABC"] == [1, 0, 2]
    assert [era.stiffness for era in back.eras] == [8e3] * 3
    assert back.document.over.data["base"] == "rig.yaml"


@pytest.mark.parametrize(("key", "off"), [("material", 0.2), ("loss_factor", 5e-5)])
def test_a_file_that_reads_back_otherwise_is_refused(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, key: str, off: float
) -> None:
    """A file whose plate cannot be changed, also by a quarter of a percent, is not the other's."""

    def change(rig: Rig) -> Rig:
        plate = replace(rig.plate, loss_factor=rig.plate.loss_factor + off)
        return replace(rig, plate=plate if key == "loss_factor" else plate.scaled(modulus=1 + off))

    def without(before: Rig, after: Rig) -> dict[str, Any]:
        keys = fitted_keys(before, after)
        del keys["plate"][key]
        return keys

    monkeypatch.setattr(rig_writing, "fitted_keys", without)
    with pytest.raises(InputError, match="read back"):
        fitted(tmp_path, FLOW, change)
    assert not (tmp_path / "rig.fitted.yaml").exists()


MASS_FOUND = PointLoad(0.05, 0.15, mass=0.004)
TWO_FEET = "supports: {a: {at: [0.1, 0.1], kind: foam}, b: {at: [0.2, 0.1], kind: foam}}\n"


def with_feet(rig: Rig, *stiffnesses: float, supports: float) -> Rig:
    """The rig with feet of other stiffnesses [N/m], which are known by so much."""
    masses = tuple(
        replace(foot, stiffness=k) for foot, k in zip(rig.masses, stiffnesses, strict=True)
    )
    return replace(rig, masses=masses, uncertainty=replace(rig.uncertainty, supports=supports))


@pytest.mark.parametrize(
    ("text", "change", "read", "expected"),
    [
        (
            REWRITTEN_BOARD,
            lambda rig: replace(rig, masses=(*rig.masses, MASS_FOUND)),
            lambda rig: [(each.stiffness, each.mass, each.x, each.y) for each in rig.masses],
            [(0.0, 0.004, 0.05, 0.15), (2000.0, 0.0, 0.1, 0.1)],
        ),
        (
            FLOW.replace("mesh: 12x9", f"{TWO_FEET}mesh: 12x9"),
            lambda rig: with_feet(rig, 345.67800001, 345.678, supports=0.05),
            lambda rig: [(each.x, each.stiffness) for each in rig.masses],
            [(0.1, 345.67800001), (0.2, 345.678)],
        ),
        (
            REWRITTEN_BOARD,
            lambda rig: with_feet(rig, 1600.0, supports=rig.uncertainty.supports),
            lambda rig: [rig.uncertainty.supports, *(each.stiffness for each in rig.masses)],
            [0.3, 1600.0],
        ),
        (
            FLOW,
            lambda rig: replace(rig, uncertainty=replace(rig.uncertainty, gain=0.01)),
            lambda rig: rig.document.over.data["uncertainty"],
            {"gain": 0.01},
        ),
    ],
    ids=["a mass beside supports", "feet alike but for a hair", "a foot by kind", "one term"],
)
def test_what_a_fit_changes_is_read_back_and_all_else_stays(
    tmp_path: Path,
    text: str,
    change: Callable[[Rig], Rig],
    read: Callable[[Rig], object],
    expected: object,
) -> None:
    """A mass comes, feet keep places and order, errors of feet and other terms are as they were."""
    _, after, output = fitted(tmp_path, text, change)
    back = load_rig(output)
    assert read(back) == expected
    assert back.uncertainty == after.uncertainty


BASES = {
    "missing": ("base: rig.yaml", "base: ring.yaml", r":\d+: base: must be an existing rig file"),
    "outside": ("base: rig.yaml", "base: ../rig.yaml", r"base: must be in the folder of this file"),
    "absolute": ("base: rig.yaml", "base: /rig.yaml", r"base: must be in the folder of this file"),
    "itself": ("base: rig.yaml", "base: rig.fitted.yaml", r"base: must be the rig file that"),
    "a number": ("base: rig.yaml", "base: 3", r"base: must be the name of a rig file, got 3"),
    "another ERA": (
        "  A:",
        "  Z:",
        r"eras.Z: must be a name in 'rig.yaml', which does not have it",
    ),
    "no fingerprint": (
        "base_fingerprint",
        "#",
        r"base: 'rig.yaml' must have the same plate, ERAs,",
    ),
    "unknown key": ("    stiffness:", "    stifness:", r"eras.A.stifness: "),
}


@pytest.mark.parametrize(("text", "other", "error"), BASES.values(), ids=BASES)
def test_a_base_that_does_not_fit_is_refused_with_its_line(
    tmp_path: Path, text: str, other: str, error: str
) -> None:
    """Missing, elsewhere, circular, of no name, and keys of what the base does not have."""
    *_, output = fitted(tmp_path, FLOW, other_values)
    written = output.read_text("utf-8")
    output.write_text(written.replace(text, other, 1), "utf-8")
    with pytest.raises(ConfigError, match=rf"rig\.fitted\.yaml.*{error}"):
        load_rig(output)


def test_a_base_may_be_wired_anew_but_not_built_anew(tmp_path: Path) -> None:
    """URL, channels, limits and units of the base hold; another plate or ERA needs another fit.

    A daemon's file in the base's place is called that, not a rig that has changed.
    """
    *_, output = fitted(tmp_path, FLOW, other_values)
    base, text = tmp_path / "rig.yaml", FLOW.replace("sim://", "serial:///dev/ttyS9")
    for one, other in (
        ("2 mm", "0.002"),
        ("[0.3, 0]", "[30 cm, 0 mm]"),
        ("channel: 2", "channel: 5"),
    ):
        assert one in text
        text = text.replace(one, other)
    base.write_text(text, "utf-8")
    back = load_rig(output)
    assert back.amplifiers == {"m": "serial:///dev/ttyS9"}
    assert back.wiring["C"].number == 5
    for wrong, said in (
        (FLOW.replace("2 mm", "3 mm"), r"'rig.yaml' must have the same plate, ERAs, masses"),
        (
            FLOW.replace("[0.3, 0]", "[0.2, 0]"),
            r"'rig.yaml' must have the same plate, ERAs, masses",
        ),
        (FLOW.replace("mesh: 12x9", "mesh: 12x"), r"rig\.yaml:3: mesh: "),
        (
            "rig: other.yaml\nsocket: era.sock\n",
            r"rig\.yaml: must be a rig, .*with .rig., .socket.",
        ),
    ):
        base.write_text(wrong, "utf-8")
        with pytest.raises(InputError, match=said):
            load_rig(output)


def test_show_and_merge_of_what_a_fit_found(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Both values side by side with the standard error, as rows and as JSON; one file of both."""
    errors: dict[KeyPath, float] = {("eras", "B", "stiffness"): 123.4}
    _, after, output = fitted(tmp_path, FLOW, other_values, errors)
    assert run_era(["rig", "show", str(output)]) == 0
    rows = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert rows[0] == ["rig.yaml", "rig.fitted.yaml", "standard", "error"]
    assert ["eras.B.stiffness", "9000", "9901", "±", "123"] in rows
    assert ["eras.A.damping_ratio", "0.1", "left", "out"] in rows
    assert ["eras.A.gains", "[]", "2", "rows"] in rows
    assert run_era(["rig", "show", str(output), "--json"]) == 0
    shown = json.loads(capsys.readouterr().out)
    assert shown["base"] == "rig.yaml"
    row = {"key": "eras.B.stiffness", "base": 9000, "fitted": 9901, "standard_error": 123}
    assert pytest.approx(row) in shown["changes"]
    whole = tmp_path / "whole.yaml"
    assert run_era(["rig", "merge", str(output), "-o", str(whole)]) == 0
    assert load_rig(whole) == load_rig(output)
    for file in (output, tmp_path / "rig.yaml"):
        with pytest.raises(InputError, match="must be another file than"):
            save_rig(load_rig(output), file)
    assert run_era(["rig", "merge", str(whole), "-o", str(tmp_path / "again.yaml")]) == 2
    assert run_era(["rig", "show", str(whole)]) == 2
    assert run_era(["rig", "merge", str(output), "-o", str(tmp_path / "rig.yaml")]) == 2
    assert (tmp_path / "rig.yaml").read_text("utf-8") == FLOW
    assert after.eras != load_rig(tmp_path / "rig.yaml").eras


def test_an_output_elsewhere_is_a_whole_rig(tmp_path: Path) -> None:
    """A fitted rig names a file beside it or below; in another folder it has all keys itself."""
    for name in ("out", "in"):
        (tmp_path / name).mkdir()
    (tmp_path / "in" / "rig.yaml").write_text(FLOW, "utf-8")
    rig = load_rig(tmp_path / "in" / "rig.yaml")
    for place in (tmp_path / "new.yaml", tmp_path / "out" / "new.yaml"):
        save_fitted(place, rig, other_values(rig), comment="new", errors={("plate", "x"): 1.0})
        assert load_rig(place).eras[0].x == 0.00123
        assert ("base: in/rig.yaml" in place.read_text("utf-8")) == (place.parent == tmp_path)
