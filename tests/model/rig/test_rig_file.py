"""Rig files: values read from a file, invalid values, warnings, and files written by a fit."""

import json
import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from controller.rig_file_check import check_rig
from era_haptics.command import run_era
from kit.direct_plate import direct_acceleration
from kit.plates import exciter_rig, exciter_rig_text
from kit.set_table import only
from model.answer.stimulus import Placement
from model.arrays import ComplexArray
from model.config.document import ConfigError, KeyPath, read_document
from model.errors import InputError
from model.fem import assemble
from model.reduction.free_plate import solve_free_plate
from model.rig import rig_writing
from model.rig.rig import Channel, Rig, Uncertainty
from model.rig.rig_file import load_rig, parse_rig
from model.rig.rig_warnings import gain_notes
from model.rig.rig_writing import fitted_keys, save_beside, save_fitted, save_rig
from model.structure.attachments import PointLoad
from model.structure.fingertips import Fingertip
from model.table.table_file import build_table

# Values, units and defaults

# One value per line: the line of a problem identifies the value.
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
HOMOGENEOUS = "  thickness: 1.5 mm\n  material: aluminium\n"
LAYERS = """\
  layers:
    - material: aluminium
      thickness: 1 mm
    - material: {E: 1 MPa, rho: 1000, nu: 0.49}
      thickness: 0.2 mm
    - {material: acrylic, thickness: 2 mm}
  bond: full
"""


def changed(text: str, *changes: tuple[str, str]) -> str:
    """The text with the first occurrence of each old part replaced by the new one."""
    for old, new in changes:
        assert old in text, old
        text = text.replace(old, new, 1)
    return text


def good_rig(*changes: tuple[str, str]) -> Rig:
    """The rig of the valid file with these changes."""
    return parse_rig("rig.yaml", changed(GOOD, *changes))


LAMINATE = changed(GOOD, (HOMOGENEOUS, LAYERS), ("48x36", "auto"))


def test_load_rig_converts_units_and_fills_in_defaults(tmp_path: Path) -> None:
    """Inches, millimeters and kilonewtons become SI units; optional keys get their defaults."""
    path = tmp_path / "rig.yaml"
    path.write_text(GOOD, encoding="utf-8")

    rig = load_rig(path)

    plate, mesh, limits = rig.plate, rig.mesh, rig.limits
    southwest, northeast = rig.eras
    assert (plate.length, plate.width, plate.thickness) == (0.3048, 0.2286, 0.0015)
    assert plate.loss_factor == 0.01
    assert (mesh.nx, mesh.ny, mesh.length, mesh.width) == (48, 36, 0.3048, 0.2286)
    assert (southwest.name, southwest.damping) == ("SW", 2.0)
    assert (northeast.name, northeast.x, northeast.y) == ("NE", 0.3048, 0.2286)
    assert (northeast.stiffness, northeast.bolt_mass, northeast.stroke) == (17000, 0, 1e-4)
    assert rig.wiring == {"SW": Channel("main", 0), "NE": Channel("main", 1)}
    assert rig.amplifiers == {"main": "sim://"}
    assert (limits.frequency_min, limits.frequency_max, limits.level) == (40, 500, 0.5)
    assert rig.masses == ()
    assert rig.fingertip == Fingertip(1000, 2, 0.0002, 0.005, 500, 2)
    assert rig.uncertainty == Uncertainty(0.05, 5.0, 0.02, 0.1, 1.5, 0.5)


def test_gains_are_read_in_radians() -> None:
    """A row of gains is a frequency, a factor and a phase in degrees."""
    rig = good_rig(("damping: 2.0", "gains: [[50, 0.9, 90], [60, 1, 0]]"))

    assert rig.eras[0].gains == ((50.0, 0.9, math.pi / 2), (60.0, 1.0, 0.0))
    assert rig.eras[1].gains == ()


def test_damping_ratio_refers_to_the_heave_of_the_plate() -> None:
    """c = zeta 2 sqrt(k m / n), with 10 % as stated and 5 % by default."""
    rig = good_rig(("damping: 2.0", "damping_ratio: 10 %"))

    mass = 2700 * 0.3048 * 0.2286 * 0.0015
    critical_damping = 2 * math.sqrt(17000 * mass / 2)
    dampings = [era.damping for era in rig.eras]
    assert dampings == pytest.approx([0.1 * critical_damping, 0.05 * critical_damping], rel=1e-12)


def test_limits_over_time_are_read_in_seconds_and_shares() -> None:
    """Slew, power, on-time and duty cycle as stated; the rate is unlimited unless stated."""
    rows = "level: 0.5\n  slew: 2 %/ms\n  power: 150 %\n  on_time: 0.5 min\n  duty: 25 %"
    limits = good_rig(("level: 0.5", rows)).limits
    rate_limits = good_rig(("level: 0.5", "rate: 0.1 kHz")).limits

    assert (limits.slew, limits.power, limits.on_time, limits.duty) == (20.0, 1.5, 30.0, 0.25)
    assert limits.rate == math.inf
    assert (rate_limits.rate, rate_limits.slew, rate_limits.duty) == (100, math.inf, 1)


def test_laminate_has_the_mass_and_thickness_of_its_layers() -> None:
    """By hand 2.7 + 0.2 + 2.38 kg/m² on 3.2 mm; a single layer is that homogeneous plate."""
    rig = parse_rig("rig.yaml", LAMINATE)
    single_layer = "  layers: [{material: aluminium, thickness: 1.5 mm}]\n"

    assert rig.plate.mass == pytest.approx(5.28 * 0.3048 * 0.2286, rel=1e-9)
    assert rig.laminate is not None
    assert rig.laminate.thickness == pytest.approx(3.2e-3)
    assert rig.laminate.bond == "full"
    assert good_rig((HOMOGENEOUS, single_layer)).fingerprint == good_rig().fingerprint


def test_fingertip_is_changed_key_by_key_or_left_out() -> None:
    """Stated keys replace the defaults; `none` computes without fingers."""
    firm = "fingertip: {stiffness: 2 kN/m, contact_mass: 0.3 g}\n"

    assert parse_rig("rig.yaml", GOOD + firm).fingertip == Fingertip(2000, 2, 0.0003, 0.005, 500, 2)
    assert parse_rig("rig.yaml", GOOD + "fingertip: none\n").fingertip is None


def test_stated_uncertainty_replaces_the_default_and_zero_is_exact() -> None:
    """A tolerance of 0, or a factor of 1, means that the value is known exactly."""
    text = GOOD + "uncertainty: {gain: 1 %, damping: 1, thickness: 0}\n"

    rig = parse_rig("rig.yaml", text)

    assert rig.uncertainty == Uncertainty(0.01, 5.0, 0.0, 0.1, 1.0, 0.5)
    assert rig.exactly_known == ("thickness", "damping")
    assert parse_rig("rig.yaml", GOOD + "uncertainty: {}\n").uncertainty == Uncertainty()


FEET = "supports:\n  a: {at: [0, 0], stiffness: 3000}\n"
TAPE = "supports:\n  a: {along: edges, stiffness_per_length: 3000}\n"


@pytest.mark.parametrize(
    ("supports", "tolerance", "exact"),
    [
        (FEET, 0.3, ()),
        (TAPE, 0.0, ()),
        (FEET + "uncertainty: {supports: 0}\n", 0.0, ("supports",)),
    ],
    ids=["feet", "tape", "exact feet"],
)
def test_feet_have_a_tolerance_unless_it_is_stated(
    supports: str, tolerance: float, exact: tuple[str, ...]
) -> None:
    """Feet vary by 30 % even when their stiffness is stated; supports along edges do not vary."""
    rig = parse_rig("rig.yaml", GOOD + supports)

    assert rig.uncertainty.supports == tolerance
    assert rig.exactly_known == exact


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
@pytest.mark.usefixtures("assumed_costs")
def test_weather_adds_to_the_tolerance_of_a_measured_plate(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], material: str, keys: str, change: float
) -> None:
    """Frequencies vary by half of 0.8 of the modulus' largest change; the check prints it."""
    plate_rows = "\n  ".join([f"material: {material}", *keys.split("; ")])
    text = changed(GOOD, ("material: aluminium", plate_rows), ("48x36", "auto"))
    path = tmp_path / "rig.yaml"
    path.write_text(text + changed(FEET, ("[0, 0]", "[0, 228.6 mm]")), encoding="utf-8")

    uncertainty = parse_rig("rig", text + "uncertainty: {thickness: 0}\n").uncertainty
    status = run_era(["config", "check", str(path)])
    output = capsys.readouterr().out

    assert 2 * uncertainty.frequency == pytest.approx(0.8 * change, rel=0.01)
    assert parse_rig("rig", text + "uncertainty: {weather: 0.01}\n").uncertainty.weather == 0.01
    assert status == 0
    assert ("change its modulus by" in output) == (change > 0)
    is_unknown = "humidity" in keys and change == 0
    assert ("nothing is known" in output) == is_unknown


def test_mesh_is_chosen_for_the_highest_frequency_when_missing() -> None:
    """D = E h³ / 12 (1 - nu²) = 22.0935 N m; wavelength 2 pi (D / rho h w²)^(1/4) = 0.1713 m."""
    without_mesh = good_rig(("mesh: 48x36\n", ""))
    without_limits = good_rig(
        ("mesh: 48x36\n", ""), ("limits:\n  frequency: [40, 500]\n  level: 0.5\n", "")
    )

    assert without_mesh.mesh == good_rig(("48x36", "auto")).mesh
    assert without_mesh.mesh.shortest_wavelength < 0.1713
    assert without_limits.mesh == without_mesh.mesh
    assert without_limits.limits == replace(without_mesh.limits, level=1.0)


# Invalid values

BOARD = (
    "{E1: 12 GPa, E2: 5 GPa, G12: 1 GPa, G13: 1 GPa, G23: 1 GPa, nu12: 0.1, rho: 700}"  # of wood
)
ISOTROPIC_BOARD = BOARD.replace("rho", "nu: 0.3, rho")
NO_G23_BOARD = BOARD.replace(", G23: 1 GPa", "")
UNSTABLE_BOARD = BOARD.replace("nu12: 0.1", "nu12: 2")
NORTHEAST = GOOD[GOOD.index("  NE:") : GOOD.index("amplifiers:")]
SOUTHWEST_WIRING = "    amplifier: main\n    channel: 0\n"
ERAS = GOOD[GOOD.index("eras:") : GOOD.index("amplifiers:")]

# Old text of the valid file, new text, expected line and key of the problem.
INVALID_VALUES = [
    ("length: 12 in", "length: .nan", "2 plate.length"),
    ("length: 12 in", "length:", "2 plate.length"),
    ("length: 12 in", "length: 304.8", "2 plate.length"),
    ("length: 12 in", "length: 12 in\n  colour: red", "3 plate.colour"),
    ("  material: aluminium\n", "", "1 plate.material"),
    ("aluminium", "7", "5 plate.material"),
    ("aluminium", "{E: 70 GPa, rho: 2700, nu: -1}", "5 plate.material.nu"),
    ("aluminium", "{E: 70 GPa, nu: 0.3}", "5 plate.material.rho"),
    ("aluminium", "{E: 1, rho: 0, nu: 0, F: 1}", "5 plate.material.F"),
    ("aluminium", "{E: 70 GPa, rho: 2700}", "5 plate.material.nu"),
    ("aluminium", "{E: 70 GPa, rho: 2700, nu: 0.3, G12: 1 GPa}", "5 plate.material.G12"),
    ("aluminium", "{rho: 2700}", "5 plate.material.E"),
    ("aluminium", UNSTABLE_BOARD, "5 plate.material"),
    ("aluminium", NO_G23_BOARD, "5 plate.material.G23"),
    ("aluminium", ISOTROPIC_BOARD, "5 plate.material.nu"),
    ("aluminium", "steel\n  grain: wide", "6 plate.grain"),
    # 0.3048 m / (0.17132 m / 6) = 10.67 and 0.2286 m / (0.17132 m / 6) = 8.01
    ("48x36", "10x9", "6 mesh"),
    ("48x36", "11x8", "6 mesh"),
    (ERAS, "eras: {}\n", "7 eras"),
    (ERAS, "", "1 eras"),
    (SOUTHWEST_WIRING + NORTHEAST, "  NE: {at: [12 in, 9 in], stiffness: 17000}\n", "7 eras"),
    ("at: [0, 0]", "at: [0, 0, 0]", "9 eras.SW.at"),
    ("at: [0, 0]", "at: [0]", "9 eras.SW.at[1]"),
    ("at: [0, 0]", "at: [0, 1 kg]", "9 eras.SW.at[1]"),
    ("at: [0, 0]", "at: [0, 9.1 in]", "9 eras.SW.at"),
    ("at: [0, 0]", "at: [-1 mm, 0]", "9 eras.SW.at"),
    ("stiffness: 17 kN/m", "stiffness: 17 N", "10 eras.SW.stiffness"),
    ("stiffness: 17 kN/m", "stiffness: 1 MN/m", "8 eras.SW.foot"),
    ("    stiffness: 17 kN/m\n", "", "8 eras.SW.stiffness"),
    ("damping: 2.0", "stroke: 100", "11 eras.SW.stroke"),
    ("damping: 2.0", "gains: [[50, 0.9, 90], [60, 0, 0]]", "11 eras.SW.gains"),
    ("damping: 2.0", "gains: [[50, 0.9, 90], [40, 1, 0]]", "11 eras.SW.gains"),
    ("    amplifier: main\n", "", "8 eras.SW.amplifier"),
    ("channel: 0", "channel: 0.5", "13 eras.SW.channel"),
    ("channel: 0", "channel: '0'", "13 eras.SW.channel"),
    ('{url: "sim://"}', "sim://", "20 amplifiers.main"),
    ('"sim://"', '"sim://", clock_error: 2 ms', "20 amplifiers.main.clock_error"),
    ("[40, 500]", "[0, 500]", "22 limits.frequency[0]"),
    ("[40, 500]", "[40, 500 rpm]", "22 limits.frequency[1]"),
    ("level: 0.5", "level: .nan", "23 limits.level"),
    ("level: 0.5", "rate: 3 kHz", "23 limits.rate"),
]
INVALID_SECTIONS = [
    ("masses: 2", "24 masses"),
    ("masses:\n  cam: {at: [0, 0]}", "25 masses.cam.mass"),
    ("masses:\n  2nd: {at: [0, 0], mass: 5 g}", "25 masses.2nd"),
    ("masses:\n  a: {mass: 1 g}", "25 masses.a.at"),
    ("masses:\n  a: {along: edges}", "25 masses.a.mass_per_length"),
    ("masses:\n  a: {along: edges, mass: 1, mass_per_length: 1}", "25 masses.a.mass"),
    ("masses:\n  a: {at: [0, 0], mass: 1, points: 50}", "25 masses.a.points"),
    ("supports:\n  a: {at: [0, 0]}", "25 supports.a.stiffness"),
    ("supports:\n  a: {at: [0, 1], kind: foam}", "25 supports.a.at"),
    ("supports:\n  a: {at: [0, 0], stiffness: 2 MN/m}", "25 supports.a.foot"),
    ("supports:\n  a: {along: edges, kind: foam}", "25 supports.a.kind"),
    ("supports:\n  a: {along: edges}", "25 supports.a.stiffness_per_length"),
    ("uncertainty:", "24 uncertainty"),
    ("uncertainty: {damping: 0.5}", "24 uncertainty.damping"),
    ("uncertainty: {thickness: 0.1}", "24 uncertainty.thickness"),
    ("uncertainty: {mass: 1}", "24 uncertainty.mass"),
    ("fingertip: heavy", "24 fingertip"),
    ("fingertip: {damping: 0}", "24 fingertip.damping"),
    ("threshold: loud", "24 threshold"),
]
INVALID_LAYERS = [
    (LAYERS, "  layers: []\n", "4 plate.layers"),
    (LAYERS, "  layers: {a: 1}\n", "4 plate.layers"),
    (LAYERS, "  layers:\n    - 7\n", "5 plate.layers[0]"),
    ("  layers:", "  thickness: 1 mm\n  layers:", "4 plate.thickness"),
    ("  layers:", "  material: steel\n  layers:", "4 plate.material"),
    ("thickness: 1 mm", "thickness: 0", "6 plate.layers[0].thickness"),
    ("thickness: 1 mm", "thickness: 300 mm", "4 plate.layers"),
    ("nu: 0.49}", "nu: 0.49, t: 1}", "7 plate.layers[1].material.t"),
    ("      thickness: 0.2 mm\n", "", "7 plate.layers[1].thickness"),
    (
        "      thickness: 0.2",
        "      loss_factor: 3\n      thickness: 1",
        "8 plate.layers[1].loss_factor",
    ),
    (
        "0.2 mm",
        "1 mm\n      by_frequency: [[20, 1, 0], [10, 1, 0]]",
        "9 plate.layers[1].by_frequency",
    ),
    (
        "0.2 mm",
        "1 mm\n      by_frequency: [[20, 0, 0], [30, 1, 0]]",
        "9 plate.layers[1].by_frequency",
    ),
    ("bond: full", "bond: glue", "10 plate.bond"),
    ("bond: full", "bond: shear", "10 plate.bond"),
]
MISSPELLED = [
    ("aluminium", "soda glass", "5 plate.material", "soda-lime-glass"),
    ("mesh:", "mehs:", "6 mehs", "mesh"),
    (
        "level: 0.5",
        f"level: 0.5\n{FEET.replace('stiffness: 3000', 'kind: foams')}",
        "25 supports.a.kind",
        "foam",
    ),
    ("level: 0.5", "level: 0.5\nplates: 2", "24 plates", "plate"),
    ("level: 0.5", "level: 0.5\nfingertip: {phalanx: 1 g}", "24 fingertip.phalanx", "phalanx_mass"),
]


def problems_of(text: str) -> dict[str, str]:
    """The message of each problem by its line and key."""
    with pytest.raises(ConfigError) as rejection:
        parse_rig("rig.yaml", text)
    problems = rejection.value.problems
    return {f"{problem.line} {problem.key}": problem.message for problem in problems}


@pytest.mark.parametrize(("old", "new", "location"), INVALID_VALUES)
def test_invalid_value_is_rejected_with_line_and_key(old: str, new: str, location: str) -> None:
    """Type, unit, range and required keys of each section are checked."""
    assert location in problems_of(changed(GOOD, (old, new)))


@pytest.mark.parametrize(("section", "location"), INVALID_SECTIONS)
def test_invalid_optional_section_is_rejected_with_line_and_key(
    section: str, location: str
) -> None:
    """Masses, supports, uncertainty, fingertip and threshold are checked like required sections."""
    assert location in problems_of(GOOD + section)


@pytest.mark.parametrize(("old", "new", "location"), INVALID_LAYERS)
def test_invalid_layer_is_rejected_with_line_and_key(old: str, new: str, location: str) -> None:
    """The key identifies the wrong layer of a laminate."""
    assert location in problems_of(changed(LAMINATE, (old, new)))


@pytest.mark.parametrize(("old", "new", "location", "suggestion"), MISSPELLED)
def test_misspelled_name_is_rejected_with_a_suggestion(
    old: str, new: str, location: str, suggestion: str
) -> None:
    """Keys, materials and kinds of supports are compared with similar names."""
    problems = problems_of(changed(GOOD, (old, new)))

    assert f"did you mean {suggestion}?" in problems[location]


# Warnings and rejections of the check

THIRD_ERA = "  SE: {at: [12 in, 0], stiffness: 17 kN/m, amplifier: main, channel: 2}\namplifiers:"


def warnings_about(key: str, text: str, path: Path) -> list[str]:
    """Warnings about a key that the check prints for a rig on three ERAs."""
    path.write_text(
        changed(text, ("amplifiers:", THIRD_ERA)).replace("48x36", "auto"), encoding="utf-8"
    )
    warnings = check_rig(read_document(path)).warnings
    return [warning for warning in warnings if warning.startswith(key)]


def test_check_rejects_a_plate_that_tips_over(tmp_path: Path) -> None:
    """Two ERAs do not hold a plate; such a file loads, so that a study can start from it."""
    path = tmp_path / "rig.yaml"
    path.write_text(GOOD, encoding="utf-8")

    assert len(load_rig(path).eras) == 2
    with pytest.raises(ConfigError, match=r":\d+: eras: "):
        check_rig(read_document(path))


@pytest.mark.usefixtures("assumed_costs")
def test_check_warns_of_a_stiff_spring_at_a_point(tmp_path: Path) -> None:
    """On 1.5 mm of aluminium a tenfold smaller point yields 11.1 nm/N: ln 10 / (2 pi 5/6 G h)."""
    old = "stiffness: 17000"
    at_point = changed(GOOD, (old, "stiffness: 1 MN/m\n    foot: 0"))
    on_foot = changed(GOOD, (old, "stiffness: 1 MN/m\n    foot: 5 mm"))

    (warning,) = warnings_about("eras.NE.foot", at_point, tmp_path / "rig.yaml")

    assert "1.1 %" in warning
    assert warnings_about("eras.NE.foot", on_foot, tmp_path / "rig.yaml") == []


@pytest.mark.parametrize(
    ("gap", "error"),
    [
        ("1.8 mm", None),
        ("1.6 mm", "off by 10 %"),
        ("0.1 mm", "off by 50 % or more"),
        ("0.5 mm, closed: true", None),
        ("0.2 mm, closed: true", "off by 10 %"),
        ("0.05 mm, closed: true", "off by 50 %"),
    ],
)
@pytest.mark.usefixtures("assumed_costs")
def test_check_warns_of_friction_in_a_thin_air_gap(
    tmp_path: Path, gap: str, error: str | None
) -> None:
    """The boundary layer is sqrt(2 1.82e-5 / (1.204 2 pi 40)) = 0.35 mm at 40 Hz."""
    text = changed(LAMINATE, ("bond: full", f"air_gap: {{depth: {gap}}}"))

    warnings = warnings_about("plate.air_gap", text, tmp_path / "rig.yaml")

    assert len(warnings) == (error is not None)
    for warning in warnings:
        assert str(error) in warning


@pytest.mark.usefixtures("assumed_costs")
def test_check_warns_of_faces_that_slide_on_soft_foam(tmp_path: Path) -> None:
    """By hand sqrt(2 x 40e3 / (0.05 x 1.767)) / 2 pi = 151 Hz for foam of G 40 kPa.

    1.767 kg/m² are a face's 1.35 and a sixth of the foam's 2.5, since it turns about its middle.
    """
    foam = "{material: {name: foam, E: MODULUS, rho: 50, nu: 0.25}, thickness: 50 mm}"
    face = "{material: aluminium, thickness: 0.5 mm}"
    sandwich = changed(GOOD, (HOMOGENEOUS, f"  layers: [{face}, {foam}, {face}]\n"))
    path = tmp_path / "rig.yaml"

    (warning,) = warnings_about("plate.layers", sandwich.replace("MODULUS", "0.1 MPa"), path)

    assert "at 151 Hz" in warning
    assert "above 75" in warning
    assert warnings_about("plate.layers", sandwich.replace("MODULUS", "100 MPa"), path) == []


# Full level, gains and ERAs without an amplifier

FOUR_ERAS = """
plate: {length: 12 in, width: 9 in, thickness: 1.5 mm, material: aluminium}
mesh: 16x12
eras:
  SW: {at: [0, 0], stiffness: 17000, amplifier: main, channel: 0}
  SE: {at: [12 in, 0], stiffness: 17000, amplifier: main, channel: 1, GAINS}
  NE: {at: [12 in, 9 in], stiffness: 17000}
  NW: {at: [0, 9 in], stiffness: 17000}
amplifiers:
  main: {url: "sim://", full_level: output}
limits: {frequency: [60, 260]}
"""
GAINS = "gains: [[40, 6, 0], [300, 2, -20]]"
FOUR_ERAS = FOUR_ERAS.replace("GAINS", GAINS)


def four_era_rig(*changes: tuple[str, str]) -> Rig:
    """The rig of two driven and two passive ERAs with these changes."""
    return parse_rig("rig.yaml", changed(FOUR_ERAS, *changes))


def test_full_level_is_a_motion_or_an_output() -> None:
    """An ERA's full level is a motion unless the file states an output; exciters need an output."""
    board = exciter_rig_text()

    assert four_era_rig((", full_level: output", "")).outputs == set()
    assert four_era_rig(("full_level: output", "full_level: motion")).outputs == set()
    assert four_era_rig().outputs == {"main"}
    board_rig = parse_rig("board.yaml", board.replace(", full_level: output", ""))
    assert board_rig.outputs == {"card"}
    with pytest.raises(ConfigError, match=r"amplifiers\.main\.full_level"):
        four_era_rig(("full_level: output", "full_level: voltage"))


def test_check_lists_eras_whose_gain_is_not_measured() -> None:
    """Only ERAs on an output need gains: neither motions nor exciters are listed."""
    (note,) = gain_notes(four_era_rig())
    (joint_note,) = gain_notes(four_era_rig((f", {GAINS}", "")))

    assert note.startswith("gains of SW: missing")
    assert joint_note == note.replace("SW", "SW, SE")
    assert gain_notes(four_era_rig(("full_level: output", "full_level: motion"))) == []
    assert gain_notes(exciter_rig()) == []


def test_check_warns_of_gains_that_are_measured_too_far_apart() -> None:
    """Halfway between rows 90 degrees apart a straight line has 0.7 of the gain.

    179 and -176 degrees are 5 apart. Rows beyond the frequency limits are not played.
    """
    rows = "gains: [[40, 2, 179], [150, 2, -176], [255, 2, 94], [300, 2, 90], [320, 2, 0]]"

    _, note = gain_notes(four_era_rig((GAINS, rows)))

    assert note.startswith("eras.SE.gains: phases differ by 90 degrees between 150 and 255 Hz")


def test_era_gain_is_interpolated_and_held_beyond_its_frequencies(coarse_rig: Rig) -> None:
    """Gains lie on the line between two complex rows and multiply their own ERA's response."""
    low, high = 0.9 * np.exp(0.2j), 1.3 * np.exp(-0.4j)
    southwest, southeast, *others = coarse_rig.eras
    gained = replace(southeast, gains=((100.0, 0.9, 0.2), (200.0, 1.3, -0.4)))
    frequencies = np.array([50.0, 100.0, 125.0, 300.0])
    points = np.array([[0.1, 0.05], [0.2, 0.2]])
    free = solve_free_plate(coarse_rig.plate, coarse_rig.mesh)

    gain = gained.gain(frequencies)
    expected = free.acceleration(coarse_rig.eras, frequencies, points)
    expected[:, 1] *= gain[:, None]
    fields = free.acceleration((southwest, gained, *others), frequencies, points)

    np.testing.assert_allclose(gain, [low, low, 0.75 * low + 0.25 * high, high])
    np.testing.assert_allclose(fields, expected, rtol=1e-10)


def test_era_without_an_amplifier_supports_and_is_not_driven() -> None:
    """Fields of the driven ERAs are the same as if the others were wired and at rest."""
    rig = four_era_rig()
    wired = four_era_rig(
        ("17000}", "17000, amplifier: side, channel: 0}"),
        ("17000}", "17000, amplifier: side, channel: 1}"),
        ("limits", '  side: {url: "sim://x"}\nlimits'),
    )
    frequencies = np.array([80.0, 220.0])
    points = np.array([[0.1, 0.06], [0.22, 0.16]])

    def direct_fields(rig: Rig) -> ComplexArray:
        matrices = assemble(rig.plate, rig.mesh)
        return direct_acceleration(matrices, rig.eras, frequencies, points, loads=rig.masses)

    fields = direct_fields(rig)
    table = build_table(rig, frequencies=np.arange(60.0, 261.0, 20.0))
    placement = Placement(((0.1, 0.06),), ((0.22, 0.16),))
    layer, _ = only(table, placement, 10.0, drive_mode="phased")

    assert rig.supports == ("NE", "NW")
    assert [era.name for era in rig.eras] == ["SW", "SE"]
    np.testing.assert_allclose(fields, direct_fields(wired)[:, :2], rtol=1e-9)
    tolerance = 0.02 * np.abs(fields).max()
    table_fields = table.unit_fields(points)[[1, 8]]
    np.testing.assert_allclose(table_fields, fields, rtol=0.02, atol=tolerance)
    assert set(layer.excitation) <= {"SW", "SE"}


# Files written by a fit

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
mesh: auto
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
PLYWOOD_ON_FOAM = changed(
    FLOW,
    ("thickness: 2 mm, material: steel", "thickness: 6 mm, material: plywood"),
    ("width: 0.2,", "width: 0.2, grain: width,"),
    ("mesh: 12x9", "supports: {foot: {at: [0.1, 0.1], kind: foam}}  # of foam"),
)
PLYWOOD_BY_NUMBERS = (
    "{E1: 12 GPa, E2: 4.8 GPa, G12: 0.7 GPa, G13: 350 MPa, G23: 250 MPa, nu12: 0.05, rho: 680}"
)
FITTED_FILES = {
    "flow": FLOW,
    "sliding layers": BLOCK,
    "bonded layers": changed(BLOCK, ("bond: none", "bond: full")),
    "board": PLYWOOD_ON_FOAM,
    "board by numbers": changed(PLYWOOD_ON_FOAM, ("plywood", PLYWOOD_BY_NUMBERS)),
    "acrylic": changed(PLYWOOD_ON_FOAM, ("plywood", "acrylic")),
}
STIFFER = 1.2345678


def fitted_rig(rig: Rig) -> Rig:
    """The rig with changed values of plate and ERAs, and with gains of the first two ERAs."""
    eras = []
    for number, era in enumerate(rig.eras):
        gains = ((50.0, 0.91234, -0.2), (60.5, 1.1, 3.0)) if number < 2 else ()
        stiffness = era.stiffness * 1.1 + number
        fitted = replace(era, stiffness=stiffness, damping=era.damping + 1.5, gains=gains)
        eras.append(replace(fitted, bolt_mass=era.bolt_mass + 0.0123456))
    eras[0] = replace(eras[0], x=0.00123)
    return replace(
        rig,
        plate=replace(rig.plate.scaled(modulus=STIFFER), loss_factor=0.0234),
        laminate=rig.laminate and rig.laminate.scaled(modulus=STIFFER),
        eras=tuple(eras),
        uncertainty=Uncertainty(0.004, 0.3, 0.002, 0.01, 1.02, 0.5),
    )


def read_base(folder: Path, text: str = FLOW) -> Rig:
    """The rig of a file in this folder."""
    path = folder / "rig.yaml"
    path.write_text(text, "utf-8")
    return load_rig(path)


def write_fit(
    folder: Path, rig: Rig, fitted: Rig, errors: Mapping[KeyPath, float] | None = None
) -> Path:
    """Write the fitted rig next to the file of its base."""
    path = folder / "rig.fitted.yaml"
    save_fitted(path, rig, fitted, comment="new\nvalues", errors=errors)
    return path


def moduli_of(rig: Rig) -> list[list[float]]:
    """The elastic moduli [Pa] of each layer."""
    laminate = rig.laminate
    materials = [layer.material for layer in laminate.layers] if laminate else [rig.plate.material]
    return [list(material.moduli.values()) for material in materials]


@pytest.mark.parametrize("is_merged", [False, True], ids=["on its base", "merged"])
@pytest.mark.parametrize("text", FITTED_FILES.values(), ids=FITTED_FILES)
def test_fitted_values_are_read_back_in_place_of_those_of_the_base(
    text: str, is_merged: bool, tmp_path: Path
) -> None:
    """Plate, layers, ERAs and uncertainty are the fitted ones; wiring and limits are the base's."""
    rig = read_base(tmp_path, text)
    fitted = fitted_rig(rig)

    path = write_fit(tmp_path, rig, fitted)
    result = load_rig(path)
    if is_merged:
        save_rig(result, tmp_path / "merged.yaml")
        result = load_rig(tmp_path / "merged.yaml")

    assert (tmp_path / "rig.yaml").read_text("utf-8") == text
    assert path.read_text("utf-8").startswith("# new\n# values\n\nbase: rig.yaml\n")
    expected_moduli = STIFFER * np.array(moduli_of(rig))
    np.testing.assert_allclose(moduli_of(result), expected_moduli, rtol=1e-12)
    assert result.plate.loss_factor == 0.0234
    assert result.plate.mass == pytest.approx(rig.plate.mass, rel=1e-9)
    for era, expected in zip(result.eras, fitted.eras, strict=True):
        assert era.damping == pytest.approx(expected.damping, rel=1e-12)
        np.testing.assert_allclose(era.gains, expected.gains, rtol=1e-12)
        assert replace(era, damping=expected.damping, gains=expected.gains) == expected
    assert result.wiring == rig.wiring
    assert result.limits == rig.limits
    assert result.uncertainty == fitted.uncertainty


def test_fit_of_a_fitted_rig_keeps_the_first_base(tmp_path: Path) -> None:
    """Channels from a first fit and stiffness from a second end in one file on the first base."""
    base = read_base(tmp_path)
    assert base.document is not None
    wired, path = tmp_path / "wired.yaml", tmp_path / "both.yaml"
    channels = {"eras": {"A": {"channel": 1}, "B": {"channel": 0}}}
    rig = save_beside(wired, base.document, channels, comment="wired")
    softer_eras = tuple(replace(era, stiffness=8e3) for era in rig.eras)

    save_fitted(path, load_rig(wired), replace(rig, eras=softer_eras), comment="fitted")
    result = load_rig(path)

    assert [result.wiring[name].number for name in "ABC"] == [1, 0, 2]
    assert [era.stiffness for era in result.eras] == [8e3] * 3
    assert result.document is not None
    assert result.document.over.data["base"] == "rig.yaml"


@pytest.mark.parametrize("key", ["material", "loss_factor"])
def test_fit_whose_file_reads_back_differently_is_not_written(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, key: str
) -> None:
    """A value that is missing in the file is noticed, even if it changed by 0.5 % of itself."""
    rig = read_base(tmp_path)
    stiffer = rig.plate.scaled(modulus=1.2)
    lossier = replace(rig.plate, loss_factor=rig.plate.loss_factor + 5e-5)
    plates = {"material": stiffer, "loss_factor": lossier}

    def keys_without_one(base: Rig, fitted: Rig) -> dict[str, Any]:
        keys = fitted_keys(base, fitted)
        del keys["plate"][key]
        return keys

    monkeypatch.setattr(rig_writing, "fitted_keys", keys_without_one)
    with pytest.raises(InputError, match="read back"):
        write_fit(tmp_path, rig, replace(rig, plate=plates[key]))
    assert not (tmp_path / "rig.fitted.yaml").exists()


def test_fitted_mass_is_written_next_to_the_supports_of_the_base(tmp_path: Path) -> None:
    """The foot of the base stays when a fit adds a mass."""
    rig = read_base(tmp_path, PLYWOOD_ON_FOAM)
    mass = PointLoad(0.05, 0.15, mass=0.004)

    path = write_fit(tmp_path, rig, replace(rig, masses=(*rig.masses, mass)))

    loads = load_rig(path).masses
    positions = [(load.x, load.y, load.mass, load.stiffness) for load in loads]
    assert positions == [(0.05, 0.15, 0.004, 0.0), (0.1, 0.1, 0.0, 2000.0)]


@pytest.mark.parametrize(
    ("old", "new", "error"),
    [
        ("base: rig.yaml", "base: ring.yaml", r":\d+: base: must be an existing rig file"),
        ("base: rig.yaml", "base: ../rig.yaml", "base: must be in the folder of this file"),
        ("base: rig.yaml", "base: /rig.yaml", "base: must be in the folder of this file"),
        ("base: rig.yaml", "base: rig.fitted.yaml", "base: must be the rig file that"),
        ("base: rig.yaml", "base: 3", "base: must be the name of a rig file, got 3"),
        ("  A:", "  Z:", "eras.Z: must be a name in 'rig.yaml', which does not have it"),
        ("base_fingerprint", "#", "base: 'rig.yaml' must have the same plate, ERAs,"),
        ("    stiffness:", "    stifness:", "eras.A.stifness: "),
    ],
    ids=[
        *("missing", "outside", "absolute", "itself", "number"),
        *("unknown ERA", "no fingerprint", "unknown key"),
    ],
)
def test_fitted_file_with_an_invalid_base_or_key_is_rejected(
    tmp_path: Path, old: str, new: str, error: str
) -> None:
    """The message names file, line and key."""
    rig = read_base(tmp_path)
    path = write_fit(tmp_path, rig, fitted_rig(rig))

    path.write_text(changed(path.read_text("utf-8"), (old, new)), "utf-8")

    with pytest.raises(ConfigError, match=rf"rig\.fitted\.yaml.*{error}"):
        load_rig(path)


@pytest.mark.parametrize(
    ("text", "error"),
    [
        (changed(FLOW, ("2 mm", "3 mm")), "'rig.yaml' must have the same plate, ERAs, masses"),
        (changed(FLOW, ("[0.3, 0]", "[0.2, 0]")), "'rig.yaml' must have the same plate, ERAs"),
        (changed(FLOW, ("mesh: 12x9", "mesh: 12x")), r"rig\.yaml:3: mesh: "),
        (
            "rig: other.yaml\nsocket: era.sock\n",
            r"rig\.yaml: must be a rig, .*with .rig., .socket.",
        ),
    ],
    ids=["other plate", "other ERA", "invalid base", "configuration of a daemon"],
)
def test_base_with_another_plate_is_rejected_after_a_fit(
    tmp_path: Path, text: str, error: str
) -> None:
    """Fitted values do not apply to another plate or other ERAs."""
    rig = read_base(tmp_path)
    path = write_fit(tmp_path, rig, fitted_rig(rig))

    (tmp_path / "rig.yaml").write_text(text, "utf-8")

    with pytest.raises(InputError, match=error):
        load_rig(path)


def test_rig_show_prints_base_and_fitted_values(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Rows and JSON have both values and the standard error of the fit."""
    rig = read_base(tmp_path)
    path = write_fit(tmp_path, rig, fitted_rig(rig), {("eras", "B", "stiffness"): 123.4})

    assert run_era(["rig", "show", str(path)]) == 0
    rows = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert run_era(["rig", "show", str(path), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)

    assert rows[0] == ["rig.yaml", "rig.fitted.yaml", "standard", "error"]
    assert ["eras.B.stiffness", "9000", "9901", "±", "123"] in rows
    assert ["eras.A.damping_ratio", "0.1", "left", "out"] in rows
    assert ["eras.A.gains", "[]", "2", "rows"] in rows
    assert report["base"] == "rig.yaml"
    row = {"key": "eras.B.stiffness", "base": 9000, "fitted": 9901, "standard_error": 123}
    assert pytest.approx(row) in report["changes"]


def test_rig_merge_writes_a_file_without_a_base_and_overwrites_no_source(tmp_path: Path) -> None:
    """The merged file is the same rig; only a fitted file can be merged or shown."""
    rig = read_base(tmp_path)
    path = write_fit(tmp_path, rig, fitted_rig(rig))
    base, merged = tmp_path / "rig.yaml", tmp_path / "merged.yaml"

    assert run_era(["rig", "merge", str(path), "-o", str(merged)]) == 0
    assert load_rig(merged) == load_rig(path)
    assert run_era(["rig", "merge", str(path), "-o", str(base)]) == 2
    assert run_era(["rig", "merge", str(path), "-o", str(path)]) == 2
    assert run_era(["rig", "merge", str(merged), "-o", str(tmp_path / "again.yaml")]) == 2
    assert run_era(["rig", "show", str(merged)]) == 2
    assert base.read_text("utf-8") == FLOW


def test_fit_written_to_another_folder_is_a_whole_rig(tmp_path: Path) -> None:
    """A base must be in the folder of the fitted file or below; otherwise all keys are written."""
    source, target = tmp_path / "source", tmp_path / "target"
    source.mkdir()
    target.mkdir()
    rig = read_base(source)

    for path in (tmp_path / "new.yaml", target / "new.yaml"):
        save_fitted(path, rig, fitted_rig(rig), comment="new", errors={("plate", "x"): 1.0})

        assert load_rig(path).eras[0].x == 0.00123
        has_base = "base: source/rig.yaml" in path.read_text("utf-8")
        assert has_base == (path.parent == tmp_path)
