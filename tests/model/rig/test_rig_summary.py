"""Keys of rig files: their reference page, plain keys and fields of a plate, and exciters.

Every key and field of a plate, also a new one, is covered: a plain key is in both solvers, in a
rigid plate and in a summary; a field is written and read back.
"""

import json
import math
import re
from dataclasses import fields, replace
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
from model.commands.plate_show_cli import show
from model.config.document import ConfigError, data_text, parse_document
from model.errors import InputError
from model.reduction.free_plate import solve_free_plate
from model.rig.plate_sections import PLAIN_KEYS, PlateSection
from model.rig.rig import Rig, Uncertainty, differences
from model.rig.rig_file import example_rig_path, parse_rig, rig_of
from model.rig.rig_summary import plate_summary
from model.rig.rig_warnings import exciter_notes, resonance_notes
from model.rig.rig_writing import document_for as keys_of
from model.structure.exciter import EXCITER_TYPES, Exciter
from model.structure.material import Material
from model.structure.plate import AirGap, Laminate, Plate
from model.structure.statics import rigid_body_frequencies
from model.transients.excursions import excursion_notes
from model.vibration import natural_modes

PLATE = {"length": 0.3, "width": 0.2, "thickness": 0.002}
GLASS = {"E": 70e9, "rho": 2500.0, "nu": 0.2}
CORNERS = {"SW": [0, 0], "SE": [0.3, 0], "NE": [0.3, 0.2], "NW": [0.01, 0.2]}
FIELDS = PlateSection.model_fields
PLAIN = {key: each for key in PLAIN_KEYS for each in quantities(FIELDS[key])}


def rig_with(key: str, mesh: str, stiffness: float = 17e3, more: float = 0.02) -> Rig:
    """A plate whose key is so much more of one unit than otherwise, on four springs."""
    start = PLATE.get(key) or FIELDS[key].default or 0.0
    plate = {**PLATE, "material": GLASS, key: start + more * min(1.0, PLAIN[key].at_most)}
    return parse_rig("rig.json", json.dumps(rig_data(plate, mesh, stiffness)))


def rig_data(plate: dict[str, Any], mesh: str, stiffness: float) -> dict[str, Any]:
    """A rig file of a plate on four springs."""
    return {
        "plate": plate,
        "mesh": mesh,
        "eras": {
            name: {
                "at": at,
                "stiffness": stiffness,
                "bolt_mass": 0.01,
                "amplifier": "main",
                "channel": number,
            }
            for number, (name, at) in enumerate(CORNERS.items())
        },
        "amplifiers": {"main": {"url": "sim://"}},
        "limits": {"frequency": [40, 300]},
    }


@pytest.mark.parametrize(
    "key", shortly([key for key in PLAIN if key != "thickness"], ["length", "loss_factor"])
)
def test_a_key_is_in_elements_and_polynomials_and_in_the_summary(key: str) -> None:
    """Responses, which it changes, within 1 %; three modes of soft springs as of a rigid plate."""
    polynomials = "14x10 Legendre"
    rigs = (
        rig_with(key, polynomials, more=0.0),
        rig_with(key, "12x8 Q5"),
        rig_with(key, polynomials),
    )
    (before, E, P) = (
        solve_free_plate(rig.plate, rig.mesh).acceleration(
            rig.eras, np.array([60.0, 150.0, 290.0]), np.array([[0.1, 0.05], [0.3, 0.2]])
        )
        for rig in rigs
    )
    assert np.linalg.norm(P - E) < 0.01 * np.linalg.norm(E)
    assert np.linalg.norm(P - before) > 1e-5 * np.linalg.norm(E)
    soft = rig_with(key, polynomials, stiffness=10.0)
    assert natural_modes(soft, 3, support="eras").frequencies == pytest.approx(
        rigid_body_frequencies(soft.plate, soft.eras), rel=1e-3
    )
    summary = plate_summary(soft)
    shown = {**summary, **summary["further"]}
    assert shown[PLAIN[key].dimension.key(key)] == getattr(soft.plate, key)


LAYERS = [{"material": {**GLASS, "name": each}, "thickness": 0.001} for each in "ab"]
FORMS: dict[str, dict[str, Any]] = {
    "laminate": {"layers": LAYERS},
    "air_gap": {"material": GLASS, "thickness": 0.002, "air_gap": {"depth": 0.004}},
}
"""Keys of a plate that has the field."""


# A surface takes the place of all other keys of a plate: tests/model/structure/test_surface.py.
@pytest.mark.parametrize("name", [each.name for each in fields(Plate) if each.name != "surface"])
def test_a_field_that_differs_is_written(name: str) -> None:
    """Of each field, also a new one: the rig's text states it, and reads back."""
    keys = FORMS.get(name, {"material": GLASS, "thickness": 0.002})
    data = rig_data({"length": 0.3, "width": 0.2, **keys}, "10x8 Legendre", 17e3)
    for era in data["eras"].values():
        era["damping"] = 3.0
    document = parse_document("rig.json", json.dumps(data))
    before = rig_of(document)
    after = with_other(before, name)
    back = rig_of(keys_of(after))
    assert differences(back, after) == []
    assert differences(back, before) != []


def with_other(rig: Rig, name: str) -> Rig:
    """The rig with another value of a field of its plate, on the same mesh."""
    plate = rig.plate
    match getattr(plate, name):
        case float() as value:
            return replace(rig, plate=replace(plate, **{name: 1.01 * value or 0.1}))
        case Laminate() as laminate:
            laminate = laminate.scaled(modulus=1.02)
            return replace(rig, plate=plate.scaled(modulus=1.02), laminate=laminate)
        case Material():
            return replace(rig, plate=plate.scaled(modulus=1.02))
        case AirGap() as gap:
            return replace(rig, plate=replace(plate, air_gap=replace(gap, depth=0.005)))
    assert name == "mode_deviations"
    deviations = ((2 * math.log(1.02), math.log(0.9)),)  # a row of six digits in the file
    return replace(rig, plate=replace(plate, mode_deviations=deviations))


OWN = (
    "coil_mass: 1.61 g, weight: 109.29 g, q: 3, force_factor: 3.63 T m, resistance: 4.3 ohm, "
    "inductance: 0.1 mH, power: 1 W"
)


def first(keys: str) -> Exciter:
    """The first exciter of a board with these keys."""
    exciter = exciter_rig(keys).eras[0]
    assert isinstance(exciter, Exciter)
    return exciter


def refused(keys: str) -> dict[str, str]:
    """Messages by key, without the first exciter's name."""
    with pytest.raises(ConfigError) as error:
        exciter_rig(keys)
    return {each.key.removeprefix("eras.SW."): each.message for each in error.value.problems}


def test_resonance_of_the_coil_and_of_the_magnet_are_one_exciter() -> None:
    """224 Hz free, 27.19 Hz mounted: k of 3189.2 N/m, c of 0.7553 N s/m, 1 W at 3.0008 V."""
    free, mounted = (
        first(f"{OWN}, resonance: {f} Hz, resonance_is: {which}")
        for f, which in ((224, "free"), (224 * math.sqrt(1.61 / 109.29), "mounted"))
    )
    assert free.stiffness == pytest.approx(3189.20, rel=1e-5)
    assert free.damping == pytest.approx(0.7553, rel=1e-4)
    assert free.voltage == pytest.approx(3.0008, rel=1e-4)
    assert mounted.stiffness == pytest.approx(free.stiffness)
    assert first(f"{OWN}, stiffness: 3 kN/m, clip: 2.5 V").voltage == 2.5


@pytest.mark.parametrize(
    ("name", "magnet", "quality", "force"),
    [("DAEX25FHE-4", 27, 5, 2.5), ("DAEX25CT-4", 60, 9, 1.15), ("DAEX13-4SM", 44, 4, 1.1)],
)
def test_types_are_those_of_their_sheets(
    name: str, magnet: float, quality: float, force: float
) -> None:
    """Resonance glued, Q with the amplifier and force at 1 W, worked out of the sheets."""
    one = first(f"type: {name}, power: 1 W")
    assert one.magnet_frequency == pytest.approx(magnet, abs=0.5)
    assert one.quality == pytest.approx(quality, abs=0.55)
    assert one.largest_force == pytest.approx(force, abs=0.05)
    assert first(f"type: {name}, weight: 50 g, magnet: held").held
    for key, stated in EXCITER_TYPES[name].values.items():
        assert stated.source or stated.assumed, key


BOTH_WAYS = f"{OWN}, resonance: 224 Hz, resonance_is: free, stiffness: 3 kN/m"


@pytest.mark.parametrize(
    ("keys", "key", "said"),
    [
        (f"{OWN}, resonance: 224 Hz", "resonance_is", "free (the light coil moves"),
        ("type: DAEX25CT-4, resonance: 60", "resonance_is", ""),
        (OWN, "resonance", "missing; add it, or a type that has it"),
        (BOTH_WAYS, "stiffness", ""),
        (BOTH_WAYS, "resonance_is", ""),
        ("type: DAEX25CT-5", "type", "did you mean DAEX25CT-4"),
        ("type: DAEX25CT-4, stroke: 1 mm", "stroke", "known: at"),
        ("type: DAEX25CT-4, power: 20 W", "power", "at most 10 W"),
    ],
    ids=[
        *("whose resonance", "whose resonance of a type", "no resonance", "stiffness twice"),
        *("resonance twice", "misspelt type", "stroke", "power"),
    ],
)
def test_what_is_wrong_is_found_at_its_key(keys: str, key: str, said: str) -> None:
    """Of the type, a resonance that does not say which, and what only ERAs have.

    A misspelt type is no reason to ask for all that it has: each of the other exciters is named
    once. A type is not blamed for another key.
    """
    found = refused(keys)
    assert said in found[key]
    if key == "type":
        assert len(found) == 4
        assert [each for each in found if not each.startswith("eras.")] == ["type"]
        assert "DAEX25CT-4" not in str(refused("type: DAEX25CT-4, q: -1"))


@pytest.mark.parametrize(
    ("right", "wrong", "key", "said"),
    [
        (
            *("kind: exciter", "kind: exiter", "kind"),
            "must be era or exciter, got 'exiter'; did you mean exciter?",
        ),
        ("amplifier: card, channel: 0, ", "", "amplifier", ""),
        ("[0.054, 0.0552]", "[3, 0.0552]", "at", ""),
    ],
    ids=["kind", "amplifier", "place"],
)
def test_a_wrong_exciter_is_found_in_its_line(right: str, wrong: str, key: str, said: str) -> None:
    """Of another kind, without an amplifier, and beside the plate."""
    text = exciter_rig_text("type: DAEX25CT-4").replace(right, wrong, 1)
    with pytest.raises(ConfigError, match=rf"board\.yaml:3: eras\.SW\.{key}: .*{re.escape(said)}"):
        parse_rig("board.yaml", text)


def warned(keys: str, frequency: str) -> list[str]:
    """Warnings of a board."""
    rig = exciter_rig(keys, frequency=frequency)
    return [*exciter_notes(rig), *excursion_notes(rig), *resonance_notes(rig)]


def test_check_warns_near_the_resonance_of_the_magnets_and_of_one_that_is_misread() -> None:
    """Below 1.3 x 44.2 = 57.5 Hz; 200 Hz of 14.3 g on a coil of 0.7 g is 44 Hz when glued."""
    (near,) = warned("type: DAEX13-4SM, power: 1 mW", "[50, 300]")
    assert near.startswith("limits.frequency: starts at 50 Hz")
    assert "start at 58 Hz" in near
    assert warned("type: DAEX13-4SM, power: 1 mW", "[58, 300]") == []
    misread, *others = warned("type: DAEX13-4SM, resonance_is: mounted", "[240, 400]")
    assert misread.startswith("resonance_is of SW, SE, NE, NW: 200 Hz is high")
    assert "at 44 Hz" in misread
    assert not [each for each in others if "start at" in each]
    (narrow,) = warned("type: DAEX13-4SM, power: 1 mW", "[50, 57]")
    assert narrow.endswith("plate alike; identify the rig")
    assert not [each for each in warned(f"{OWN}, stiffness: 3190", "[100, 300]") if "high" in each]


@pytest.mark.long
def test_check_says_at_which_frequencies_a_magnet_would_leave_its_excursion() -> None:
    """On a rigid heavy board a magnet moves as on one that is held, and furthest in an onset.

    Within 1 % of the magnet's own equation, M x'' + c' x' + k x = F exp(st), from rest. A check of
    a file that plays down to 40 Hz warns of it.
    """
    text = exciter_rig_text("type: DAEX13-4SM, power: 1 W", frequency="[40, 300]")
    warnings = RIG.check(parse_document("board.yaml", text)).warnings
    far = "from 40 Hz on limits.level 1 can move the magnets of SW, SE, NE, NW beyond"
    assert [each for each in warnings if far in each]
    exciter = first("type: DAEX13-4SM, power: 1 W")
    heavy = exciter_rig_text("type: DAEX13-4SM, power: 1 W").replace("rho: 1190", "rho: 100000")
    stiff = parse_rig("board.yaml", heavy.replace("E: 4.5 GPa", "E: 9000 GPa"))
    (said,) = excursion_notes(replace(stiff, uncertainty=Uncertainty.none()))
    mass, k = exciter.magnet_mass, exciter.stiffness
    c = exciter.damping + 1.5**2 / 3.7
    p, q = np.roots([mass, c, k])
    frequencies, times = np.arange(65.0, 160.0), np.arange(0, 0.3, 2e-4)[:, None]
    s = 2j * np.pi * frequencies
    share = (s - q) / (p - q)
    shape = np.exp(s * times) - share * np.exp(p * times) - (1 - share) * np.exp(q * times)
    moved = np.abs(1.118 / (mass * s**2 + c * s + k) * shape).max(axis=0)
    stated = re.search(r"within from (\S+) Hz on.*at most (\S+) is safe", said)
    allowed = frequencies[moved > 0.5e-3][-1] + 1
    assert [*map(float, stated.groups())] == pytest.approx(
        [allowed, 0.5e-3 / moved.max()], rel=0.01
    )


def test_what_may_harm_an_exciter_is_said() -> None:
    """Power beyond the type's is refused, as is a current that cannot follow; by hand the rest.

    3 x 3.0 V on 4.3 + 0.1 ohm are 9 W of the 1 W that is stated; 1 mH at 300 Hz are 0.18 of 4.4 ohm
    squared; at 60 Hz free 1.61 g hang from k = 228.8 N/m, and 109.29 g from it 4.7 mm lower.
    """
    with pytest.raises(InputError, match="inductance of exciter SW must let"):
        exciter_rig("type: DAEX25CT-4, force_factor: 10, inductance: 5 mH")
    own = f"{OWN}, resonance: 224 Hz, resonance_is: free"
    gains = ", gains: [[50, 3, 0], [300, 3, 0]]"
    for keys, key, said in (
        (f"{own}{gains}, excursion: 9 mm", "gains", "put 9 W into the coil"),
        (f"{own}{gains}, excursion: 9 mm, clip: 4 V", "gains", "ask for 9 V"),
        (own, "excursion", "missing"),
        (own.replace("0.1 mH", "1 mH"), "inductance", "is 0.18 at 300 Hz"),
        (own.replace("224", "60") + ", excursion: 1 mm", "resonance", "sags 4.7 mm"),
    ):
        notes = [each for each in warned(keys, "[100, 300]") if each.startswith(f"eras.SW.{key}")]
        assert [note for note in notes if said in note], (key, warned(keys, "[100, 300]"))
    assert not [each for each in warned(f"{own}, excursion: 9 mm", "[100, 300]") if "eras" in each]


def test_a_fitted_exciter_is_written_and_reads_back() -> None:
    """Stiffness and damping take the place of resonance and q."""
    text = exciter_rig_text("type: DAEX25CT-4, resonance: 300, resonance_is: free, q: 4")
    before = parse_rig("board.yaml", text)
    fitted = replace(
        before.eras[0].varied(stiffness=1.2, damping=0.8),
        magnet_mass=0.03,
        force_factor=1.6,
        gains=((60.0, 0.9, 0.1), (200.0, 0.8, -0.2)),
    )
    after = replace(before, eras=(fitted, *before.eras[1:]))
    written = keys_of(after)
    back = rig_of(written)
    for key in ("stiffness", "damping", "magnet_mass", "coil_mass", "force_factor", "voltage"):
        assert getattr(back.eras[0], key) == pytest.approx(getattr(fitted, key), rel=1e-5)
    assert "resonance" not in data_text(written.data)


@pytest.mark.parametrize(
    ("name", "levels", "lowest"),
    [
        ("DAEX25FHE-4", {150: 41, 200: 42, 300: 29}, 40),
        pytest.param("DAEX25CT-4", {150: 36, 200: 36, 300: 23}, 40, marks=pytest.mark.long),
        # Below 50 Hz the magnet of one board in ten would leave its excursion.
        pytest.param("DAEX13-4SM", {150: 35, 200: 36, 300: 22}, 50, marks=pytest.mark.long),
    ],
)
def test_show_prints_exciters_and_what_they_reach(
    name: str,
    levels: dict[int, float],
    lowest: int,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Least level over the acrylic board at 1 W as another program found it, to 1.3 dB."""
    path = tmp_path / "board.yaml"
    path.write_text(exciter_rig_text(f"type: {name}, power: 1 W", frequency="[40, 300]"))
    show(str(path), as_json=True)
    found = json.loads(capsys.readouterr().out)
    by_frequency = dict(
        zip(found["reach"]["frequencies_hz"], found["reach"]["least_level_db_sl"], strict=True)
    )
    assert {f: by_frequency[f] for f in levels} == pytest.approx(levels, abs=1.3)
    assert found["reach"]["from_hz"] == lowest
    assert found["exciters"][0].keys() >= {"magnet_resonance_hz", "q", "force_at_1_w_n"}
    show(str(path), as_json=False)
    text = capsys.readouterr().out
    where = "under a finger everywhere except within 2 cm of the edges (nominal board)"
    assert f"20 dB SL (vibrotactile-probe) {where}: from {lowest} Hz" in text


@pytest.mark.parametrize(
    ("keys", "is_good"),
    [
        ({}, True),
        ({"plate": {"length": 0.3}}, False),
        pytest.param(
            {"base": "rig.yaml", "base_fingerprint": "f0", "plate": {"thickness": 2e-3}},
            True,
            id="fitted",
        ),
        ({"base": "rig.yaml", "eras": {"SW": {"damping": 2.0, "damping_ratio": None}}}, True),
        ({"base": "rig.yaml", "standard_errors": {"plate": {"thickness": 1e-5}}}, True),
        ({"base": "rig.yaml", "eras": {"NE": {"force_factor": 4.2}}}, True),
        ({"base": "rig.yaml", "plate": {"thickness": True}}, False),
        ({"base": "rig.yaml", "eras": {"SW": {"stifness": 1.0}}}, False),
        ({"base_fingerprint": "f0"}, False),
        ({"supports": {"a": {"at": [0, 0], "kind": "foam", "stiffness": 3000}}}, True),
        ({"supports": {"a": {"along": "edges", "stiffness_per_length": 3000}}}, True),
        ({"supports": {"a": {"at": [0, 0]}}}, False),
        (
            {
                "supports": {
                    "a": {"at": [0, 0], "kind": "foam", "along": "edges", "stiffness_per_length": 1}
                }
            },
            False,
        ),
        ({"base": "rig.yaml", "supports": {"a": {"stiffness": 3000}}}, True),
    ],
)
def test_schema_knows_whole_rigs_and_fitted_ones(keys: dict[str, Any], is_good: bool) -> None:
    """As a validator of another project reads it: the example, and what differs from a base."""
    whole = {} if "base" in keys else yaml.safe_load(example_rig_path().read_text("utf-8"))
    assert jsonschema_rs.is_valid(RIG.schema(), {**whole, **keys}) == is_good
