"""Keys of rig files: plain keys and fields of a plate, exciters, and the schema.

Every key and field of a plate, also a new one, is covered: a plain key is in both solvers, in a
rigid plate and in a summary; a field is written and read back.
"""

import json
import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import jsonschema_rs
import numpy as np
import pytest
import yaml

from cases import shortly
from controller.rig_file_check import RIG
from key_tables import quantities
from kit.plates import exciter_rig, exciter_rig_text
from model.arrays import ComplexArray
from model.commands.plate_show_cli import show
from model.config.document import ConfigError, data_text, parse_document
from model.errors import InputError
from model.reduction.free_plate import solve_free_plate
from model.rig.plate_sections import PLAIN_KEYS, PlateSection
from model.rig.rig import Rig, Uncertainty
from model.rig.rig_file import example_rig_path, parse_rig, rig_of
from model.rig.rig_summary import plate_summary
from model.rig.rig_warnings import exciter_notes, resonance_notes
from model.rig.rig_writing import document_for
from model.structure.exciter import EXCITER_TYPES, Exciter
from model.structure.statics import rigid_body_frequencies
from model.transients.excursions import excursion_notes
from model.vibration import natural_modes

# Keys and fields of a plate

PLATE = {"length": 0.3, "width": 0.2, "thickness": 0.002}
GLASS = {"E": 70e9, "rho": 2500.0, "nu": 0.2}
CORNERS = {"SW": [0, 0], "SE": [0.3, 0], "NE": [0.3, 0.2], "NW": [0.01, 0.2]}
FIELDS = PlateSection.model_fields
QUANTITIES = {key: quantity for key in PLAIN_KEYS for quantity in quantities(FIELDS[key])}
POLYNOMIALS, ELEMENTS = "14x10 Legendre", "12x8 Q5"


def rig_on_springs(plate: dict[str, Any], mesh: str, stiffness: float = 17e3) -> Rig:
    """The rig of a plate on four springs."""
    eras = {}
    for number, (name, position) in enumerate(CORNERS.items()):
        channel = {"amplifier": "main", "channel": number}
        spring = {"at": position, "stiffness": stiffness, "damping": 3.0, "bolt_mass": 0.01}
        eras[name] = spring | channel
    data = {
        "plate": plate,
        "mesh": mesh,
        "eras": eras,
        "amplifiers": {"main": {"url": "sim://"}},
        "limits": {"frequency": [40, 300]},
    }
    return parse_rig("rig.json", json.dumps(data))


def rig_with(key: str, mesh: str, *, added: float = 0.02, stiffness: float = 17e3) -> Rig:
    """A plate with a key whose value is larger than the usual one, by a share of its unit."""
    usual = PLATE.get(key) or FIELDS[key].default or 0.0
    value = usual + added * min(1.0, QUANTITIES[key].at_most)
    return rig_on_springs({**PLATE, "material": GLASS, key: value}, mesh, stiffness)


def response(rig: Rig) -> ComplexArray:
    """Acceleration at two points and three frequencies."""
    free = solve_free_plate(rig.plate, rig.mesh)
    frequencies, points = np.array([60.0, 150.0, 290.0]), np.array([[0.1, 0.05], [0.3, 0.2]])
    return free.acceleration(rig.eras, frequencies, points)


@pytest.mark.parametrize(
    "key", shortly([key for key in QUANTITIES if key != "thickness"], ["length", "loss_factor"])
)
def test_key_changes_elements_polynomials_and_summary_alike(key: str) -> None:
    """Responses of both solvers are within 1 %; soft springs have the modes of a rigid plate."""
    soft_rig = rig_with(key, POLYNOMIALS, stiffness=10.0)

    responses = response(rig_with(key, POLYNOMIALS))
    expected = response(rig_with(key, ELEMENTS))
    usual = response(rig_with(key, POLYNOMIALS, added=0.0))
    modes = natural_modes(soft_rig, 3, support="eras").frequencies
    summary = plate_summary(soft_rig)

    size = np.linalg.norm(expected)
    assert np.linalg.norm(responses - expected) < 0.01 * size
    assert np.linalg.norm(responses - usual) > 1e-5 * size
    assert modes == pytest.approx(rigid_body_frequencies(soft_rig.plate, soft_rig.eras), rel=1e-3)
    rows = {**summary, **summary["further"]}
    assert rows[QUANTITIES[key].dimension.key(key)] == getattr(soft_rig.plate, key)


# Exciters

OWN = (
    "coil_mass: 1.61 g, weight: 109.29 g, q: 3, force_factor: 3.63 T m, resistance: 4.3 ohm, "
    "inductance: 0.1 mH, power: 1 W"
)


def first_exciter(keys: str) -> Exciter:
    """The first exciter of a board with these keys."""
    exciter = exciter_rig(keys).eras[0]
    assert isinstance(exciter, Exciter)
    return exciter


def problems_of(keys: str) -> dict[str, str]:
    """Messages by key, without the first exciter's name."""
    with pytest.raises(ConfigError) as rejection:
        exciter_rig(keys)
    problems = rejection.value.problems
    return {problem.key.removeprefix("eras.SW."): problem.message for problem in problems}


def test_resonance_of_the_coil_and_of_the_magnet_are_one_exciter() -> None:
    """224 Hz free, 27.19 Hz mounted: k of 3189.2 N/m, c of 0.7553 N s/m, 1 W at 3.0008 V."""
    mounted_frequency = 224 * math.sqrt(1.61 / 109.29)

    free = first_exciter(f"{OWN}, resonance: 224 Hz, resonance_is: free")
    mounted = first_exciter(f"{OWN}, resonance: {mounted_frequency} Hz, resonance_is: mounted")

    assert free.stiffness == pytest.approx(3189.20, rel=1e-5)
    assert free.damping == pytest.approx(0.7553, rel=1e-4)
    assert free.voltage == pytest.approx(3.0008, rel=1e-4)
    assert mounted.stiffness == pytest.approx(free.stiffness)
    assert first_exciter(f"{OWN}, stiffness: 3 kN/m, clip: 2.5 V").voltage == 2.5


@pytest.mark.parametrize(
    ("name", "resonance", "quality", "force"),
    [("DAEX25FHE-4", 27, 5, 2.5), ("DAEX25CT-4", 60, 9, 1.15), ("DAEX13-4SM", 44, 4, 1.1)],
)
def test_types_are_those_of_their_sheets(
    name: str, resonance: float, quality: float, force: float
) -> None:
    """Resonance glued, Q with the amplifier and force at 1 W, worked out from the sheets."""
    exciter = first_exciter(f"type: {name}, power: 1 W")

    assert exciter.magnet_frequency == pytest.approx(resonance, abs=0.5)
    assert exciter.quality == pytest.approx(quality, abs=0.55)
    assert exciter.largest_force == pytest.approx(force, abs=0.05)
    assert first_exciter(f"type: {name}, weight: 50 g, magnet: held").held
    for key, entry in EXCITER_TYPES[name].values.items():
        assert entry.source or entry.assumed, key


@pytest.mark.parametrize(
    ("keys", "key", "message"),
    [
        (f"{OWN}, resonance: 224 Hz", "resonance_is", "free (the light coil moves"),
        ("type: DAEX25CT-4, resonance: 60", "resonance_is", ""),
        (OWN, "resonance", "missing; add it, or a type that has it"),
        (f"{OWN}, resonance: 224 Hz, resonance_is: free, stiffness: 3 kN/m", "stiffness", ""),
        ("type: DAEX25CT-4, stroke: 1 mm", "stroke", "known: at"),
        ("type: DAEX25CT-4, power: 20 W", "power", "at most 10 W"),
    ],
    ids=["whose resonance", "whose of a type", "no resonance", "both", "stroke", "power"],
)
def test_invalid_exciter_is_rejected_with_its_key(keys: str, key: str, message: str) -> None:
    """An ambiguous or missing resonance, keys that only ERAs have, and too much power."""
    assert message in problems_of(keys)[key]


@pytest.mark.parametrize(
    ("old", "new", "key", "message"),
    [
        ("kind: exciter", "kind: exiter", "kind", "got 'exiter'; did you mean exciter?"),
        ("amplifier: card, channel: 0, ", "", "amplifier", ""),
        ("[0.054, 0.0552]", "[3, 0.0552]", "at", ""),
    ],
    ids=["kind", "amplifier", "position"],
)
def test_invalid_exciter_is_rejected_with_its_line(
    old: str, new: str, key: str, message: str
) -> None:
    """An unknown kind, no amplifier, and a position off the plate."""
    text = exciter_rig_text("type: DAEX25CT-4").replace(old, new, 1)

    with pytest.raises(
        ConfigError, match=rf"board\.yaml:3: eras\.SW\.{key}: .*{re.escape(message)}"
    ):
        parse_rig("board.yaml", text)


def test_fitted_exciter_is_written_and_reads_back() -> None:
    """Stiffness and damping take the place of resonance and q."""
    text = exciter_rig_text("type: DAEX25CT-4, resonance: 300, resonance_is: free, q: 4")
    rig = parse_rig("board.yaml", text)
    fitted = replace(
        rig.eras[0].varied(stiffness=1.2, damping=0.8),
        magnet_mass=0.03,
        force_factor=1.6,
        gains=((60.0, 0.9, 0.1), (200.0, 0.8, -0.2)),
    )

    document = document_for(replace(rig, eras=(fitted, *rig.eras[1:])))
    exciter = rig_of(document).eras[0]

    for key in ("stiffness", "damping", "magnet_mass", "coil_mass", "force_factor", "voltage"):
        assert getattr(exciter, key) == pytest.approx(getattr(fitted, key), rel=1e-5), key
    assert "resonance" not in data_text(document.data)


# Warnings of exciters


def notes_of(keys: str, frequency: str) -> list[str]:
    """Warnings of a board within these frequencies."""
    rig = exciter_rig(keys, frequency=frequency)
    return [*exciter_notes(rig), *excursion_notes(rig), *resonance_notes(rig)]


def test_check_warns_near_the_resonance_of_the_magnets() -> None:
    """Below 1.3 x 44.2 = 57.5 Hz."""
    keys = "type: DAEX13-4SM, power: 1 mW"

    (note,) = notes_of(keys, "[50, 300]")
    (narrow_note,) = notes_of(keys, "[50, 57]")

    assert note.startswith("limits.frequency: starts at 50 Hz")
    assert "start at 58 Hz" in note
    assert narrow_note.endswith("plate alike; identify the rig")
    assert notes_of(keys, "[58, 300]") == []


def test_check_warns_of_a_resonance_that_is_probably_of_the_coil() -> None:
    """200 Hz for 14.3 g on a coil of 0.7 g is 44 Hz when glued."""
    note, *others = notes_of("type: DAEX13-4SM, resonance_is: mounted", "[240, 400]")

    assert note.startswith("resonance_is of SW, SE, NE, NW: 200 Hz is high")
    assert "at 44 Hz" in note
    assert "start at" not in " ".join(others)
    assert "high" not in " ".join(notes_of(f"{OWN}, stiffness: 3190", "[100, 300]"))


@pytest.mark.long
def test_check_states_the_frequencies_at_which_a_magnet_leaves_its_excursion() -> None:
    """On a rigid heavy board a magnet moves as on one that is held, and furthest in an onset.

    Within 1 % of the magnet's own equation, M x'' + c' x' + k x = F exp(st), from rest. A check of
    a file that plays down to 40 Hz warns of it.
    """
    keys = "type: DAEX13-4SM, power: 1 W"
    document = parse_document("board.yaml", exciter_rig_text(keys, frequency="[40, 300]"))
    heavy = exciter_rig_text(keys).replace("rho: 1190", "rho: 100000")
    heavy_rig = parse_rig("board.yaml", heavy.replace("E: 4.5 GPa", "E: 9000 GPa"))
    exciter = first_exciter(keys)

    warnings = "\n".join(RIG.check(document).warnings)
    (note,) = excursion_notes(replace(heavy_rig, uncertainty=Uncertainty.none()))

    far = "from 40 Hz on limits.level 1 can move the magnets of SW, SE, NE, NW beyond"
    assert far in warnings
    mass, stiffness = exciter.magnet_mass, exciter.stiffness
    damping = exciter.damping + 1.5**2 / 3.7
    p, q = np.roots([mass, damping, stiffness])
    frequencies, times = np.arange(65.0, 160.0), np.arange(0, 0.3, 2e-4)[:, None]
    s = 2j * np.pi * frequencies
    share = (s - q) / (p - q)
    transient = share * np.exp(p * times) + (1 - share) * np.exp(q * times)
    steady = 1.118 / (mass * s**2 + damping * s + stiffness)
    excursions = np.abs(steady * (np.exp(s * times) - transient)).max(axis=0)
    lowest = frequencies[excursions > 0.5e-3][-1] + 1
    stated = re.search(r"within from (\S+) Hz on.*at most (\S+) is safe", note)
    assert stated is not None
    lowest_stated, level_stated = map(float, stated.groups())
    assert lowest_stated == pytest.approx(lowest, rel=0.01)
    assert level_stated == pytest.approx(0.5e-3 / excursions.max(), rel=0.01)


FREE_COIL = f"{OWN}, resonance: 224 Hz, resonance_is: free"
TRIPLE_GAIN = ", gains: [[50, 3, 0], [300, 3, 0]]"


@pytest.mark.parametrize(
    ("keys", "key", "message"),
    [
        (f"{FREE_COIL}{TRIPLE_GAIN}, excursion: 9 mm", "gains", "put 9 W into the coil"),
        (f"{FREE_COIL}{TRIPLE_GAIN}, excursion: 9 mm, clip: 4 V", "gains", "ask for 9 V"),
        (FREE_COIL, "excursion", "missing"),
        (FREE_COIL.replace("0.1 mH", "1 mH"), "inductance", "is 0.18 at 300 Hz"),
        (FREE_COIL.replace("224", "60") + ", excursion: 1 mm", "resonance", "sags 4.7 mm"),
    ],
    ids=["power", "voltage", "excursion", "inductance", "sag"],
)
def test_check_warns_of_what_can_harm_an_exciter(keys: str, key: str, message: str) -> None:
    """3 x 3.0 V on 4.3 + 0.1 ohm are 9 W instead of the 1 W that is stated.

    1 mH at 300 Hz are 0.18 of 4.4 ohm squared; at 60 Hz free 1.61 g hang from k = 228.8 N/m, and
    109.29 g from it 4.7 mm lower.
    """
    notes = notes_of(keys, "[100, 300]")

    about_key = [note for note in notes if note.startswith(f"eras.SW.{key}")]
    assert message in "\n".join(about_key), notes


def test_current_that_cannot_follow_is_rejected() -> None:
    """5 mH with a force factor of 10 T m."""
    with pytest.raises(InputError, match="inductance of exciter SW must let"):
        exciter_rig("type: DAEX25CT-4, force_factor: 10, inductance: 5 mH")


@pytest.mark.parametrize(
    ("name", "levels", "lowest"),
    [
        ("DAEX25FHE-4", {150: 41, 200: 42, 300: 29}, 40),
        pytest.param("DAEX25CT-4", {150: 36, 200: 36, 300: 23}, 40, marks=pytest.mark.long),
        # Below 50 Hz the magnet of one board in ten would leave its excursion.
        pytest.param("DAEX13-4SM", {150: 35, 200: 36, 300: 22}, 50, marks=pytest.mark.long),
    ],
)
def test_show_prints_exciters_and_their_reach(
    name: str,
    levels: dict[int, float],
    lowest: int,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Lowest level over the acrylic board at 1 W as another program computed it, to 1.3 dB."""
    path = tmp_path / "board.yaml"
    path.write_text(exciter_rig_text(f"type: {name}, power: 1 W", frequency="[40, 300]"))

    show(str(path), as_json=True)
    report = json.loads(capsys.readouterr().out)
    show(str(path), as_json=False)
    text = capsys.readouterr().out

    reach = report["reach"]
    reached = dict(zip(reach["frequencies_hz"], reach["least_level_db_sl"], strict=True))
    assert {frequency: reached[frequency] for frequency in levels} == pytest.approx(levels, abs=1.3)
    assert reach["from_hz"] == lowest
    assert report["exciters"][0].keys() >= {"magnet_resonance_hz", "q", "force_at_1_w_n"}
    region = "under a finger everywhere except within 2 cm of the edges (nominal board)"
    assert f"20 dB SL (vibrotactile-probe) {region}: from {lowest} Hz" in text


# The schema

ON_BASE = {"base": "rig.yaml"}
TAPE = {"along": "edges", "stiffness_per_length": 3000}


@pytest.mark.parametrize(
    ("keys", "is_valid"),
    [
        ({}, True),
        ({"plate": {"length": 0.3}}, False),
        ({**ON_BASE, "base_fingerprint": "f0", "plate": {"thickness": 2e-3}}, True),
        ({**ON_BASE, "eras": {"SW": {"damping": 2.0, "damping_ratio": None}}}, True),
        ({**ON_BASE, "standard_errors": {"plate": {"thickness": 1e-5}}}, True),
        ({**ON_BASE, "eras": {"NE": {"force_factor": 4.2}}}, True),
        ({**ON_BASE, "plate": {"thickness": True}}, False),
        ({**ON_BASE, "eras": {"SW": {"stifness": 1.0}}}, False),
        ({**ON_BASE, "supports": {"a": {"stiffness": 3000}}}, True),
        ({"base_fingerprint": "f0"}, False),
        ({"supports": {"a": {"at": [0, 0], "kind": "foam", "stiffness": 3000}}}, True),
        ({"supports": {"a": TAPE}}, True),
        ({"supports": {"a": {"at": [0, 0]}}}, False),
        ({"supports": {"a": {"at": [0, 0], "kind": "foam", **TAPE}}}, False),
    ],
)
def test_schema_describes_whole_rigs_and_fitted_rigs(keys: dict[str, Any], is_valid: bool) -> None:
    """As a validator of another project reads it: the example, and changes to a base."""
    whole = {} if "base" in keys else yaml.safe_load(example_rig_path().read_text("utf-8"))

    assert jsonschema_rs.is_valid(RIG.schema(), {**whole, **keys}) == is_valid
