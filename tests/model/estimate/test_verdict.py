"""Which resonance, feet and exciters the file of a weekend's board has, and the board has not.

A board on exciters as sold: sound ones pass, and each mistake of a maker is named.

Which side a board's grain runs along: boards of a weekend, drawn as their parts deviate.

Whether measured responses can be of one plate, and of which polarity.

Diagnosis from responses that another solver computes for a known truth.

Truth comes from one sparse solve a frequency (`model.fem`), the comparison from the
reduced plate. Gains of 5 % and 5 degrees at random and noise of 2 % of each row are in every
measurement.
"""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import controller.cli.rig_cli
import plates
from benchmarks.identification.mistakes import on_glue
from benchmarks.weekend.chain import FOLDER, BuiltBoard
from controller.cli.main import run
from long_form import shortly
from model.arrays import FloatArray
from model.errors import InputError
from model.estimate import causes
from model.estimate.calibrate import MAX_OUTLIERS, calibrate
from model.estimate.calibration_fit import sensed_plate, without_outliers
from model.estimate.diagnosis_report import as_json, channel_table, verdict_rows
from model.estimate.measurement import (
    MeasuredPlate,
    Responses,
    read_measured,
    responses_of,
    write_responses,
)
from model.estimate.plate_match import MAX_FIT_ERROR, ShapeMatch, match_plate, phases_of_drive
from model.estimate.verdict import (
    Verdict,
    check_consistency,
    check_meaning,
    diagnose,
    judged_by_promises,
)
from model.fem import Mesh
from model.rig.rig import Rig
from model.rig.rig_file import load_rig
from model.spectral.direct_solution import direct_spectral_acceleration
from model.spectral.modes import SpectralMesh
from model.structure.exciter import Exciter
from plates import DISTORTIONS, exciter_rig, make_paper_rig, noise_like, perturbed, random_gains
from plates import measured as plates_measured

TONES = np.arange(91.0, 300.0, 20.0)
NAMES = ("NE", "NW", "SW", "SE")


def given_as(which: str, resonance: float = 306.0) -> Rig:
    """The board of the page, whose file has a resonance, by default its sheet's, as one of both."""
    keys = {"resonance": resonance, "resonance_is": which}
    return load_rig(FOLDER / "rig.yaml").replaced(eras=dict.fromkeys(NAMES, keys))


def measured(rig: Rig, seed: int) -> Responses:
    """What one moved sensor reads of a board whose parts deviate, at every place or at four."""
    found = BuiltBoard.drawn(rig, seed).measured(TONES, seed)
    return found if seed % 2 else found.without(np.arange(12) % 3 > 0)


@pytest.mark.parametrize(
    ("true", "written", "glued"), [("free", "mounted", 60), ("mounted", "free", 306)]
)
def test_the_other_resonance_is_named_before_anything_is_fitted(
    true: str, written: str, glued: int
) -> None:
    """Six boards: 306 Hz of a coil of 1.29 g are 306 sqrt(1.29 / 33.5) = 60 Hz of a magnet."""
    said = rf"^resonance_is of NE, NW, SW, SE must be {true}, got {written}: .* at {glued} Hz"
    for seed in range(6):
        with pytest.raises(InputError, match=said):
            check_consistency(given_as(written), measured(given_as(true), seed))


def test_wiring_is_judged_by_the_right_resonance() -> None:
    """Nothing is called reversed or loose, but two exchanged plugs are found."""
    found = measured(given_as("free"), 3)
    swapped = replace(found, values=found.values[:, [0, 2, 1, 3]])
    verdict = diagnose(given_as("mounted"), swapped)
    first, second, *others = verdict_rows(verdict)
    assert first.startswith("RESONANCE: resonance_is of NE, NW, SW, SE must be free, got mounted")
    assert second.startswith("SWAPPED: channel 1 of amplifier card (ERA NW in the rig)")
    assert others == []
    assert not verdict.is_well
    assert as_json(verdict)["plate"]["resonance_is"] == dict.fromkeys(NAMES, "free")


def test_a_resonance_that_differs_little_is_refused_with_what_is_at_a_bound() -> None:
    """60 Hz of the magnet, given as of its coil, are 12 Hz: from 91 Hz on both move alike."""
    found, rig = measured(given_as("free"), 1), given_as("free", 60.0)
    with pytest.raises(InputError, match=r"^stiffness of .* 10 times it.* resonance_is"):
        calibrate(rig, found, check_consistency(rig, found))


def test_feet_of_another_kind_are_refused_at_their_bound(tmp_path: Path) -> None:
    """Of foam below the board and of rubber in its file, ten times as stiff or more."""
    text = (FOLDER / "rig.yaml").read_text(encoding="utf-8")
    (tmp_path / "rig.yaml").write_text(text.replace("foam", "rubber"), encoding="utf-8")
    found, rubber = measured(given_as("free"), 1), load_rig(tmp_path / "rig.yaml")
    with pytest.raises(InputError, match=r"^stiffness of feet .* 0\.1 times it"):
        calibrate(rubber, found, check_consistency(rubber, found))


def test_a_dead_exciter_is_no_calibrated_rig(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The file would say that it moves the plate: exit status 1, and what to type instead."""
    found, made = measured(given_as("free"), 1), tmp_path / "made.yaml"
    values = found.values.copy()
    values[:, 2] *= 1e-4
    write_responses(tmp_path / "m.uff", replace(found, values=values), given_as("free"))
    assert run(["calibrate", str(FOLDER / "rig.yaml"), f"{tmp_path}/m.uff", "-o", str(made)]) == 1
    said = "".join(capsys.readouterr())
    assert "SW did not; no rig is written. Find out why by era rig check" in said
    assert "Next:" not in said
    assert not made.exists()


EXCITERS_CHECKED_TONES = np.arange(41.0, 300.0, 20.0)
PLACES = np.array([(0.3 * x, 0.23 * y) for x in (0.1, 0.4, 0.88) for y in (0.15, 0.5, 0.85)])
PARTS = "uncertainty: {gain: 0.2, phase_deg: 10, stiffness: 0.2, modulus: 0.1, thickness: 0.02}"


def as_sold(rig: Rig, seed: int) -> Rig:
    """A board of another rigidity (10 %) with exciters whose parts differ (20 %, 10 degrees)."""
    rng = np.random.default_rng(seed)

    def factor(deviation: float) -> float:
        return float(np.exp(deviation * rng.standard_normal()))

    eras = tuple(
        replace(
            era,
            stiffness=factor(0.2) * era.in_time.stiffness,
            magnet_mass=factor(0.2) * getattr(era, "magnet_mass"),  # noqa: B009
            force_factor=factor(0.2) * getattr(era, "force_factor"),  # noqa: B009
            gains=((100.0, factor(0.2), float(np.radians(10) * rng.standard_normal())),),
        )
        for era in rig.eras
    )
    return replace(rig, plate=rig.plate.scaled(modulus=factor(0.1)), eras=eras)


def checked(
    seed: int,
    *,
    loose: int | None = None,
    glue: float = 0.0,
    wired: FloatArray | None = None,
) -> Verdict:
    """A board checked by nine sensors with 0.5 % of noise.

    glue [N/m]: of the loose exciter; wired (e, s): signs of what is read.
    """
    rig = exciter_rig("type: DAEX25FHE-4, power: 1 W", frequency="[40, 300]", more=PARTS)
    true = as_sold(rig, seed)
    assert isinstance(rig.mesh, SpectralMesh)
    sources = [
        on_glue(era, glue) if number == loose and isinstance(era, Exciter) else era
        for number, era in enumerate(true.eras)
    ]
    values = direct_spectral_acceleration(
        true.plate, rig.mesh, sources, EXCITERS_CHECKED_TONES, PLACES, loads=true.masses
    )
    values = values / np.array([era.full_level for era in rig.eras])[:, None]
    size = np.sqrt((np.abs(values) ** 2).mean(axis=2, keepdims=True))
    noise = np.random.default_rng([seed, 1]).standard_normal((2, *values.shape))
    values = values + 0.005 * size * (noise[0] + 1j * noise[1])
    signs = np.ones(values.shape[1:]) if wired is None else wired
    names = tuple(f"P{number}" for number in range(1, len(PLACES) + 1))
    return diagnose(rig, Responses(names, PLACES, EXCITERS_CHECKED_TONES, signs * values))


@pytest.mark.parametrize("seed", [3, 4])
def test_sound_board_of_parts_as_sold_is_well(seed: int) -> None:
    """Gains and force factors that are 20 % off together are no weak exciter, nor another plate."""
    assert verdict_rows(checked(seed)) == ["ALL WELL: plate and channels match the rig"]


@pytest.mark.parametrize("glue", [600.0, 4000.0])
def test_exciter_whose_glue_is_off_is_loose_and_nothing_else(glue: float) -> None:
    """By its dynamic stiffness, or by how its gain rises; its size may be that of a weak one."""
    verdict = checked(5, loose=2, glue=glue)
    assert [channel.states[0] for channel in verdict.channels] == ["well", "well", "loose", "well"]
    rows = verdict_rows(verdict)
    assert rows[0].startswith("LOOSE: channel 2 of amplifier card (ERA NE in the rig)")
    assert not any(row.startswith("PLATE") for row in rows)


def test_exciter_wired_backwards_and_sensor_upside_down_are_told_apart() -> None:
    """One has the opposite sign at every sensor, the other under every exciter."""
    signs = np.ones((4, len(PLACES)))
    signs[1] *= -1
    signs[:, 4] *= -1
    verdict = checked(6, wired=signs)
    assert [channel.states for channel in verdict.channels] == [
        ("well",), ("inverted",), ("well",), ("well",)
    ]  # fmt: skip
    (sensor,) = verdict.bad_sensors
    assert sensor.name == "P5"
    assert "upside down" in sensor.why


def test_shapes_that_are_alike_beyond_rounding_have_no_error() -> None:
    """A MAC of one place is 1 but for rounding, as 1 + 2.2e-16."""
    assert ShapeMatch(np.full((3, 1, 1), 1 + 2.3e-16), (0.0, 0.0)).error == 0.0


@pytest.fixture(scope="module")
def rig() -> Rig:
    """The board of the page, grain along its length."""
    return load_rig(FOLDER / "rig.yaml")


@pytest.fixture(scope="module")
def across(rig: Rig) -> Rig:
    """The same cut the other way."""
    return rig.replaced(plate={"grain": "width"})


@pytest.fixture(scope="module")
def turned(across: Rig) -> Responses:
    """Measured on a board that is cut the other way."""
    return measured(across, 1)


def test_boards_cut_as_their_file_says_are_not_accused(rig: Rig) -> None:
    """Twenty whose parts deviate as bought ones do, half of them by four of the twelve places."""
    for seed in range(20):
        check_meaning(rig, measured(rig, seed))


def test_boards_cut_the_other_way_are_accused_of_that_alone(rig: Rig, across: Rig) -> None:
    """Ten, before anything is fitted in full."""
    for seed in range(10):
        with pytest.raises(InputError, match=r"^plate\.grain must be width, got length: "):
            check_consistency(rig, measured(across, seed))


def test_the_other_side_is_named_and_wiring_is_judged_on_the_board_itself(
    across: Rig, rig: Rig
) -> None:
    """The file says width, the board has length, and two plugs are exchanged: both are said."""
    found = measured(rig, 3)
    verdict = diagnose(across, replace(found, values=found.values[:, [0, 2, 1, 3]]))
    first, second = verdict_rows(verdict)[:2]
    assert first.startswith("GRAIN: plate.grain must be length, got width: ")
    assert second.startswith("SWAPPED: channel 1 of amplifier card (ERA NW in the rig)")
    assert not verdict.is_well
    assert as_json(verdict)["plate"]["grain"]["found"] == "length"


@pytest.mark.parametrize(
    "command",
    [
        "calibrate {rig} {file} -o {made}",
        "rig identify {rig} --measured {file} -o {made}",
        "rig identify {rig} --yes -o {made}",
        "rig check {rig} --measured {file}",
    ],
)
def test_commands_say_so_and_write_no_rig(
    command: str,
    turned: Responses,
    rig: Rig,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """By a file, and of what amplifiers would have measured."""
    here = MeasuredPlate(turned.as_measurement(), None, None, (), (), {})
    monkeypatch.setattr(controller.cli.rig_cli, "measured_by_amplifiers", lambda *_, **__: here)
    file, made = tmp_path / "measured.uff", tmp_path / "made.yaml"
    write_responses(file, turned, rig)
    typed = command.format(rig=FOLDER / "rig.yaml", file=file, made=made)
    assert run(typed.split()) != 0
    assert "plate.grain must be width, got length" in "".join(capsys.readouterr())
    assert not made.exists()


FREQUENCIES = np.arange(60.0, 421.0, 40.0)

NAMED = {
    "g": "9.80665",
    "velocity": "velocity in m/s",
    "displacement": "displacement in m",
    "opposite": "SW, SE, NE and NW",
    "conjugated": "exp",
    "swapped_channels": "SW and SE",
    "swapped_sensors": "P1 at that of P6, P6 at that of P1",
    "two_sensors": "got 2",
}
"""By distortion, what the refusal names."""


@pytest.fixture(scope="module")
def consistency_rig() -> Rig:
    """The paper's plate on a coarse mesh."""
    return make_paper_rig(16, 12)


@pytest.fixture(scope="module")
def responses(consistency_rig: Rig) -> Responses:
    """Of a plate within a builder's tolerances, with 1 % noise."""
    return plates_measured(
        perturbed(consistency_rig, frequencies=FREQUENCIES), frequencies=FREQUENCIES
    )


@pytest.mark.parametrize(
    "name", shortly(DISTORTIONS, ["g", "velocity", "displacement", "two_sensors"])
)  # the errors of the others are provoked in tests/errors
def test_distorted_responses_are_refused_by_their_cause(
    consistency_rig: Rig, responses: Responses, name: str
) -> None:
    """Each distortion alone, with its own cause named."""
    with pytest.raises(InputError, match=NAMED[name]):
        check_consistency(consistency_rig, DISTORTIONS[name](responses))


def test_plate_of_another_length_is_refused_by_its_length(
    consistency_rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A plate that is a fifth longer than the rig's, sensors where they are said to be.

    Of few sizes and causes; whole searches are tested with diagnoses.
    """
    monkeypatch.setattr(causes, "_SIZES", (0.82, 1.21))
    monkeypatch.setattr(causes, "_FITTED_CAUSES", 3)
    monkeypatch.setattr(causes, "_REFINED_CAUSES", 1)
    monkeypatch.setattr(causes, "_REFINEMENTS", 3)
    plate = replace(consistency_rig.plate, length=1.2 * consistency_rig.plate.length)
    eras = tuple(replace(era, x=1.2 * era.x) for era in consistency_rig.eras)
    longer = replace(
        consistency_rig, plate=plate, eras=eras, mesh=Mesh(16, 12, plate.length, plate.width)
    )
    found = plates_measured(perturbed(longer, frequencies=FREQUENCIES), frequencies=FREQUENCIES)
    with pytest.raises(InputError, match=r"plate\.length"):
        check_consistency(consistency_rig, found)


@pytest.mark.parametrize(
    ("degrees", "sign"), [(0.0, 1), (80.0, 1), (-80.0, 1), (100.0, -1), (-100.0, -1), (180.0, -1)]
)
def test_phases_of_drive_inverts_beyond_a_quarter_turn(degrees: float, sign: int) -> None:
    """Measured is what was predicted, turned by an angle; that is found, and the nearer sign."""
    rng = np.random.default_rng(0)
    predicted = rng.standard_normal((5, 1, 4)) + 1j * rng.standard_normal((5, 1, 4))
    turned = predicted * np.exp(1j * math.radians(degrees))
    observation = Responses(
        tuple("ABCD"), np.zeros((4, 2)), np.arange(5.0), turned, has_phases=True
    )
    (phase,) = phases_of_drive(observation, predicted)
    assert phase.degrees == pytest.approx(degrees, abs=1e-6)
    assert phase.sign == sign
    assert phase.confidence == pytest.approx(1.0)


def verdict_on(consistency_rig: Rig, *, loss: float, stiffness: float) -> Verdict:
    """Verdict on a plate with these factors, from responses of the sparse solve."""
    eras = tuple(replace(era, stiffness=stiffness * era.stiffness) for era in consistency_rig.eras)
    plate = replace(consistency_rig.plate, loss_factor=loss * consistency_rig.plate.loss_factor)
    truth = replace(consistency_rig, plate=plate, eras=eras)
    responses = plates_measured(truth, frequencies=FREQUENCIES, noise=0.005)
    return judged_by_promises(diagnose(consistency_rig, responses), consistency_rig)


def test_plate_with_more_loss_and_less_stiffness_has_a_verdict_of_its_own() -> None:
    """60 % more loss and 20 % less stiffness: wiring well, both named."""
    verdict = verdict_on(make_paper_rig(16, 12), loss=1.6, stiffness=0.8)
    assert verdict.wiring_matches
    told = as_json(verdict)
    assert told["wiring_matches"]
    assert told["plate"]["changes"]["loss_factor"] == pytest.approx(0.6, abs=0.15)
    assert told["plate"]["changes"]["stiffness"] == pytest.approx(-0.2, abs=0.03)


def test_plate_as_written_costs_nothing() -> None:
    """The rig's own plate: no change of more than 5 %, and more than nine of ten promises kept."""
    verdict = verdict_on(make_paper_rig(16, 12), loss=1.0, stiffness=1.0)
    assert verdict.is_well
    assert verdict.changes is not None
    assert max(map(abs, verdict.changes.values())) < 0.05
    assert verdict.kept_share is not None
    assert verdict.kept_share > 0.9


EXAMPLES = Path(__file__).parents[3] / "examples"
DIAGNOSIS_FREQUENCIES = np.linspace(57.0, 487.0, 10)


def within_tolerance(rig: Rig, rng: np.random.Generator) -> Rig:
    """A plate as builders build it by the rig's file: E ±5 %, h ±2 %, k ±10 %, damping x2."""
    material = replace(rig.plate.material, E=rig.plate.material.E * rng.uniform(0.95, 1.05))
    plate = replace(
        rig.plate,
        material=material,
        thickness=rig.plate.thickness * rng.uniform(0.98, 1.02),
        loss_factor=rig.plate.loss_factor * 2 ** rng.uniform(-1, 1),
    )
    eras = tuple(
        replace(
            era,
            stiffness=era.stiffness * rng.uniform(0.9, 1.1),
            damping=era.damping * 2 ** rng.uniform(-1, 1),
            bolt_mass=rng.uniform(0, 0.004),
        )
        for era in rig.eras
    )
    return replace(rig, plate=plate, eras=eras)


def diagnosis_measured(truth: Rig, rng: np.random.Generator) -> Responses:
    """Responses with the gains and the noise of every measurement."""
    eras = tuple(
        replace(era, gains=random_gains(rng, DIAGNOSIS_FREQUENCIES, size=0.05, phase=np.radians(5)))
        for era in truth.eras
    )
    return plates.measured(replace(truth, eras=eras), frequencies=DIAGNOSIS_FREQUENCIES, noise=0.02)


def states(verdict: Verdict) -> dict[str, tuple[str, ...]]:
    """What is wrong with channels, by the ERA in the rig."""
    return {c.era: c.states for c in verdict.channels if c.states != ("well",)}


@pytest.fixture(autouse=True, scope="module")
def solved_once():
    """Free plates of the causes that are tried are those of one rig in all tests."""
    solved = {}

    def solve(rig, points, frequencies, *, masses):
        key = (rig.plate, rig.mesh, points.tobytes(), frequencies.tobytes())
        if key not in solved:
            solved[key] = sensed_plate(rig, points, frequencies, masses=masses)
        return solved[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(causes, "sensed_plate", solve)
        yield


@pytest.fixture(scope="module")
def built(coarse_rig: Rig) -> Responses:
    """Responses of one plate within tolerance."""
    rng = np.random.default_rng(7)
    return diagnosis_measured(within_tolerance(coarse_rig, rng), rng)


@pytest.mark.parametrize("seed", shortly(range(2), [0]))
def test_diagnose_passes_a_plate_within_tolerance_and_finds_a_swap(coarse_rig, seed):
    """No false alarm, and none missed, whichever two channels are exchanged.

    A dead sensor and one that is upside down and half are named and left out of the first verdict.
    """
    rng = np.random.default_rng(1000 + seed)
    built = diagnosis_measured(within_tolerance(coarse_rig, rng), rng)
    broken, values = built.values.copy(), built.values.copy()
    broken[:, :, 5] = 1e-9
    broken[:, :, 2] *= -0.5
    well = diagnose(coarse_rig, replace(built, values=broken))
    assert well.is_well
    assert [each.name for each in well.bad_sensors] == ["P6", "P3"]
    one, other = rng.choice(4, size=2, replace=False)
    values[:, [one, other]] = values[:, [other, one]]
    swapped = diagnose(coarse_rig, replace(built, values=values))
    names = {coarse_rig.eras[one].name, coarse_rig.eras[other].name}
    assert [set(cycle) for cycle in swapped.swapped] == [names]
    (row,) = verdict_rows(swapped)
    assert row.startswith("SWAPPED: ")
    assert states(swapped).keys() == names
    assert swapped.plate_matches
    assert min(c.confidence for c in swapped.channels) > 0.95


def test_diagnose_puts_exchanged_sensors_right(coarse_rig: Rig, built: Responses) -> None:
    """Nothing is wrong but where P2 and P10 are: neither is upside down, none is left out."""
    values, order = built.values.copy(), [*range(len(built.sensors))]
    order[1], order[9] = order[9], order[1]
    verdict = diagnose(coarse_rig, replace(built, values=values[:, :, order]))
    (row,) = verdict_rows(verdict)
    assert row.startswith("PLACES: ")
    assert "P2 at that of P10, P10 at that of P2" in row
    assert not verdict.is_well
    assert verdict.wiring_matches
    assert verdict.plate_matches
    assert as_json(verdict)["plate"]["exchanged_sensors"] == {"P2": "P10", "P10": "P2"}


@pytest.mark.parametrize(
    "axes",
    shortly([("x",), ("y",), ("x", "y"), ("frequency",)], [("x", "y"), ("frequency",)]),
)
def test_axes_noted_the_other_way_round_are_named_and_put_right(axes: tuple[str, ...]) -> None:
    """Places from another edge, or frequencies backwards, of a board without symmetry: no plugs."""
    rig = load_rig(EXAMPLES / "weekend" / "rig.yaml")
    right = responses_of(read_measured(EXAMPLES / "weekend" / "measured.uff"), rig)
    few = np.flatnonzero(right.frequencies < 400)[:: len(right.frequencies) // 12]
    right = replace(right, frequencies=right.frequencies[few], values=right.values[few])
    size = np.array([rig.plate.length, rig.plate.width])
    mirrored = np.where(["x" in axes, "y" in axes], size - right.points, right.points)
    values = right.values[::-1] if "frequency" in axes else right.values
    noted = replace(right, points=mirrored, values=values)
    with pytest.raises(InputError, match=" and ".join(axes)):
        check_consistency(rig, noted)
    verdict = diagnose(rig, noted)
    row, *_ = verdict_rows(verdict)
    assert row.startswith("PLACES: ")
    assert as_json(verdict)["plate"]["reversed_axes"] == [*axes]
    assert not verdict.is_well
    assert verdict.wiring_matches


def test_mirrored_places_on_a_symmetric_plate_may_be_exchanged_channels(
    coarse_rig: Rig, built: Responses
) -> None:
    """The paper's corners: a calibration says both, a check what plugs would be."""
    mirrored = np.array([coarse_rig.plate.length, 0]) - built.points * [1, -1]
    noted = replace(built, points=mirrored)
    with pytest.raises(InputError, match=r"mirrored in x.*channels"):
        check_consistency(coarse_rig, noted)
    cycles = {frozenset(each) for each in diagnose(coarse_rig, noted).swapped}
    assert cycles == {frozenset({"SW", "SE"}), frozenset({"NW", "NE"})}


def test_verdict_names_the_sensors_first_where_all_channels_are_inverted(
    coarse_rig: Rig, built: Responses
) -> None:
    """One line: there are no others that they could be opposite to."""
    (row,) = verdict_rows(diagnose(coarse_rig, replace(built, values=-built.values)))
    assert row.startswith("INVERTED: all channels")
    assert "turn the sensors over" in row


def test_diagnose_relates_gain_to_that_of_a_calibrated_rig(
    coarse_rig: Rig, built: Responses
) -> None:
    """Of gains of 1.5 in its file a channel that plays 1.5 is well, and one that plays 1 weak."""
    eras = tuple(replace(era, gains=((200.0, 1.5, 0.0),)) for era in coarse_rig.eras)
    played = built.values * np.array([1.5, 1.5, 1.0, 1.5])[:, None]
    verdict = diagnose(replace(coarse_rig, eras=eras), replace(built, values=played))
    assert states(verdict) == {coarse_rig.eras[2].name: ("weak",)}
    assert verdict.channels[0].gain == pytest.approx(1.0, abs=0.1)
    assert verdict.channels[2].gain == pytest.approx(1 / 1.5, abs=0.1)


def test_diagnose_relates_gain_to_the_stroke_that_is_driven(coarse_rig, built):
    """SW and SE exchanged, SE with twice the stroke: a share of it is twice what was asked of SW.

    Nothing is wrong with the channels but where they are wired to.
    """
    sw, se, *others = coarse_rig.eras
    rig = replace(coarse_rig, eras=(sw, replace(se, stroke=2 * sw.stroke), *others))
    exchanged = built.values[:, [1, 0, 2, 3]] * np.array([2, 1 / 2, 1, 1])[:, None]
    verdict = diagnose(rig, replace(built, values=exchanged))
    assert [c.drives for c in verdict.channels][:2] == ["SE", "SW"]
    assert states(verdict) == {"SW": ("other ERA",), "SE": ("other ERA",)}
    for channel in verdict.channels:
        assert channel.gain == pytest.approx(1.0, rel=0.25)


def test_diagnose_finds_a_cycle_of_three_channels(coarse_rig, built):
    """SW's channel drives SE, SE's NE, NE's SW: which permutation it is, is found."""
    verdict = diagnose(coarse_rig, replace(built, values=built.values[:, [1, 2, 0, 3]]))
    assert verdict.swapped == (("SW", "SE", "NE"),)
    assert verdict_rows(verdict)[0].startswith("SWAPPED in a cycle")
    assert [c.drives for c in verdict.channels] == ["SE", "NE", "SW", "NW"]


def test_diagnose_finds_dead_weak_and_inverted_channels(coarse_rig, built):
    """Each is named with its gain; a dead one whether sensors read nothing or noise."""
    values = built.values
    rng = np.random.default_rng(3)
    broken = values.copy()
    broken[:, 0] *= 1e-4
    broken[:, 1] *= 0.4
    broken[:, 3] *= -1
    verdict = diagnose(coarse_rig, replace(built, values=broken))
    assert states(verdict) == {"SW": ("dead",), "SE": ("weak",), "NW": ("inverted",)}
    found = [row.partition(":")[0] for row in verdict_rows(verdict)]
    assert found == ["DEAD", "WEAK", "INVERTED"]
    assert verdict.channels[1].gain == pytest.approx(0.4, rel=0.1)
    assert abs(verdict.channels[3].phase or 0) == pytest.approx(180, abs=10)
    assert verdict.plate_matches
    broken = values.copy()
    broken[:, 2] = noise_like(values, 0.1, rng)[:, 2]
    assert states(diagnose(coarse_rig, replace(built, values=broken))) == {"NE": ("dead",)}


def test_verdict_asks_for_the_sensitivity_where_all_channels_are_strong(coarse_rig, built):
    """Three times what was commanded at every channel is one line, of the sensors."""
    verdict = diagnose(coarse_rig, replace(built, values=3 * built.values))
    assert set(states(verdict).values()) == {("strong",)}
    (row,) = verdict_rows(verdict)
    assert row.startswith("STRONG: the channels of SW, SE, NE, NW play")
    assert "check the sensors' sensitivity first" in row


def test_diagnose_finds_a_channel_on_another_era(coarse_rig, built):
    """SW's plug is in NW's socket, and NW's hangs free: another ERA, and a dead channel."""
    values = built.values
    broken = values.copy()
    broken[:, 0], broken[:, 3] = values[:, 3], 1e-6
    verdict = diagnose(coarse_rig, replace(built, values=broken))
    assert states(verdict) == {"SW": ("other ERA",), "NW": ("dead",)}
    assert verdict.channels[0].drives == "NW"
    assert verdict.swapped == ()
    assert any(row.startswith("WRONG ERA: channel 0") for row in verdict_rows(verdict))


def test_diagnose_finds_two_channels_on_one_era(coarse_rig, built):
    """SE's plug is beside SW's at 0.3 of its stroke: each channel has a gain of its own."""
    values = built.values
    broken = values.copy()
    broken[:, 1] = 0.3 * values[:, 0]
    channels = diagnose(coarse_rig, replace(built, values=broken)).channels
    assert [each.drives for each in channels] == ["SW", "SW", "NE", "NW"]
    assert channels[1].gain == pytest.approx(0.3 * channels[0].gain, rel=0.02)
    assert channels[0].gain == pytest.approx(1.0, rel=0.1)


def test_diagnose_judges_no_polarity_without_phases(coarse_rig, built):
    """Of a channel that is inverted all but its sign is found well."""
    values = built.values
    rng = np.random.default_rng(5)
    turned = values * np.array([1, 1, 1, -1])[None, :, None]
    loose = turned * np.exp(1j * rng.uniform(0, 6, (*turned.shape[:2], 1)))
    verdict = diagnose(coarse_rig, replace(built, values=loose, has_phases=False))
    assert verdict.is_well
    assert {channel.phase for channel in verdict.channels} == {None}


def longer(rig: Rig, factor: float) -> Rig:
    """A longer plate with its ERAs at its corners."""
    plate = replace(rig.plate, length=factor * rig.plate.length)
    eras = tuple(replace(era, x=factor * era.x) for era in rig.eras)
    mesh = Mesh(14, 9, plate.length, plate.width)
    return replace(rig, plate=plate, eras=eras, mesh=mesh)


def changed(rig: Rig, what: str) -> Rig:
    """A plate that is not the rig's."""
    match what:
        case "plate.thickness":
            return replace(rig, plate=replace(rig.plate, thickness=0.002))
        case "plate.length":
            return longer(rig, 1.2)
        case "eras.stiffness":
            return replace(
                rig, eras=tuple(replace(era, stiffness=2.2 * era.stiffness) for era in rig.eras)
            )
        case _:  # a bolt of NE is loose
            loose = replace(rig.eras[2], stiffness=200.0, damping=0.05)
            return replace(rig, eras=(*rig.eras[:2], loose, rig.eras[3]))


@pytest.mark.parametrize(
    ("what", "value", "within"),
    [
        ("plate.thickness", 0.002, 0.04),
        ("plate.length", 1.2 * 0.3048, 0.04),
        ("eras.NE.stiffness", 200.0, 0.12),
    ],
)
@pytest.mark.long
def test_diagnose_names_what_explains_another_plate(coarse_rig, what, value, within):
    """The first of the explanations is the truth, its value within what is uncertain otherwise."""
    rng = np.random.default_rng(11)
    truth = changed(within_tolerance(coarse_rig, rng), what)
    verdict = diagnose(coarse_rig, diagnosis_measured(truth, rng))
    assert not verdict.plate_matches
    first = verdict.explanations[0]
    assert first.cause.key == what
    assert first.value == pytest.approx(value, rel=within)
    assert first.share > 0.5


def test_diagnose_finds_a_swap_on_another_plate(coarse_rig, monkeypatch):
    """Exchanged channels on a plate with other springs: both are found, of few sizes."""
    monkeypatch.setattr(causes, "_SIZES", (0.82, 1.21))
    rng = np.random.default_rng(13)
    built = diagnosis_measured(changed(coarse_rig, "eras.stiffness"), rng)
    exchanged = replace(built, values=built.values[:, [0, 2, 1, 3]])
    verdict = diagnose(coarse_rig, exchanged)
    assert verdict.swapped == (("SE", "NE"),)
    assert not verdict.plate_matches
    assert verdict.explanations[0].cause.key == "eras.stiffness"
    assert verdict.explanations[0].value == pytest.approx(2.2 * 17000, rel=0.12)
    assert "eras.stiffness " in "\n".join(verdict_rows(verdict))
    report = json.loads(json.dumps(as_json(verdict)))
    assert report["plate"]["explanations"][0]["key"] == "eras.stiffness"
    assert report["all_well"] is False


def test_diagnose_finds_all_channels_dead_when_nothing_moves(coarse_rig, built):
    """Each is dead, and nothing is known of the plate."""
    verdict = diagnose(coarse_rig, replace(built, values=1e-5 * built.values))
    assert set(states(verdict).values()) == {("dead",)}
    assert len(verdict_rows(verdict)) == 4
    assert len(channel_table(verdict)) == 5
    assert as_json(verdict)["plate"]["unexplained"] is None


def test_diagnose_refuses_too_few_sensors_or_frequencies(coarse_rig, built):
    """Two sensors, three frequencies, or no channel at all."""
    with pytest.raises(InputError, match=r"at least 3 sensors .* got 2"):
        diagnose(coarse_rig, DISTORTIONS["two_sensors"](built))
    few = replace(built, frequencies=DIAGNOSIS_FREQUENCIES[:3], values=built.values[:3])
    with pytest.raises(InputError, match="got 3"):
        diagnose(coarse_rig, few)
    with pytest.raises(InputError, match="driven"):
        diagnose(coarse_rig, replace(built, values=np.full_like(built.values, np.nan)))


def test_diagnose_skips_channels_that_were_not_driven(coarse_rig, built):
    """A channel without values is reported as such, the others are judged."""
    values = built.values
    part = values.copy()
    part[:, 1:3] = np.nan
    verdict = diagnose(coarse_rig, replace(built, values=part))
    assert states(verdict) == {"SE": ("not driven",), "NE": ("not driven",)}
    assert verdict.is_well


def with_glitches(built: Responses) -> Responses:
    """Three in a hundred values wrong by far, one way or another."""
    rng = np.random.default_rng(0)
    broken = built.values.copy()
    wrong = rng.random(broken.shape) < 0.03
    broken[wrong] *= rng.choice([0.1, 4.0, -1.0], wrong.sum())
    return replace(built, values=broken)


def test_match_plate_is_not_moved_by_outliers(coarse_rig, built):
    """They move parameters by a tenth of their prior."""
    plate = sensed_plate(coarse_rig, built.points, built.frequencies)
    clean, found = (
        match_plate(plate, each.values, drives=range(4)) for each in (built, with_glitches(built))
    )
    assert np.sqrt(((found.z - clean.z) ** 2).mean()) < 0.1


def test_diagnose_passes_a_plate_of_which_some_values_are_glitches(coarse_rig, built):
    """Neither plate nor a sensor with some of them is blamed, and it is said that they were."""
    verdict = diagnose(coarse_rig, with_glitches(built))
    assert verdict.is_well
    assert verdict.bad_sensors == ()
    row, well = verdict_rows(verdict)
    assert row.startswith("OUTLIERS: 1")
    assert well.startswith("ALL WELL")


def test_diagnose_names_a_sensor_with_a_loose_contact(coarse_rig, built):
    """Its sign is another one at four of ten frequencies: it is well at most of its values."""
    values = built.values.copy()
    values[:8:2, :, 4] *= -1
    verdict = diagnose(coarse_rig, replace(built, values=values))
    assert verdict.is_well
    row, _ = verdict_rows(verdict)
    assert "16 of them of sensor P5" in row


def test_chance_counts_all_values(coarse_rig, built):
    """3.385 standard deviations are 1 normal number in 1400, and 1 in 100 sets of 14."""
    plate = sensed_plate(coarse_rig, built.points, built.frequencies)
    match = match_plate(plate, built.values, drives=range(4))
    assert replace(match, z=3.385 * np.eye(14)[3]).chance == pytest.approx(0.01, rel=0.01)


def test_match_plate_takes_no_misfit_for_outliers(coarse_rig):
    """Of a plate 3 % longer than its rig's a calibration would leave a tenth of all values out."""
    rng = np.random.default_rng(1003)
    built = diagnosis_measured(longer(within_tolerance(coarse_rig, rng), 1.03), rng)
    plate = sensed_plate(coarse_rig, built.points, built.frequencies)
    match = match_plate(plate, built.values, drives=range(4))
    used = without_outliers(built.values, match.predicted)[-1]
    assert 0.05 < (~used).mean() < MAX_OUTLIERS
    assert match.error > MAX_FIT_ERROR
