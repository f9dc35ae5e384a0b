"""Diagnosis from responses that another solver computes for a known truth.

Truth comes from one sparse solve a frequency (`model.fem`), the comparison from the
reduced plate. Gains of 5 % and 5 degrees at random and noise of 2 % of each row are in every
measurement.
"""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import plates
from long_form import shortly
from model.calibration.calibrate import MAX_OUTLIERS
from model.calibration.fit import sensed_plate, without_outliers
from model.calibration.responses import Responses, read_measured, responses_of
from model.diagnosis import causes
from model.diagnosis.diagnosis_report import as_json, channel_table, verdict_rows
from model.diagnosis.plate_match import MAX_FIT_ERROR, match_plate
from model.diagnosis.verdict import Verdict, check_consistency, diagnose
from model.errors import InputError
from model.fem import Mesh
from model.rig.rig import Rig
from model.rig.rig_file import load_rig
from plates import DISTORTIONS, noise_like, random_gains

EXAMPLES = Path(__file__).parents[3] / "examples"
FREQUENCIES = np.linspace(57.0, 487.0, 10)


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


def measured(truth: Rig, rng: np.random.Generator) -> Responses:
    """Responses with the gains and the noise of every measurement."""
    eras = tuple(
        replace(era, gains=random_gains(rng, FREQUENCIES, size=0.05, phase=np.radians(5)))
        for era in truth.eras
    )
    return plates.measured(replace(truth, eras=eras), frequencies=FREQUENCIES, noise=0.02)


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
    return measured(within_tolerance(coarse_rig, rng), rng)


@pytest.mark.parametrize("seed", shortly(range(2), [0]))
def test_diagnose_passes_a_plate_within_tolerance_and_finds_a_swap(coarse_rig, seed):
    """No false alarm, and none missed, whichever two channels are exchanged.

    A dead sensor and one that is upside down and half are named and left out of the first verdict.
    """
    rng = np.random.default_rng(1000 + seed)
    built = measured(within_tolerance(coarse_rig, rng), rng)
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
    verdict = diagnose(coarse_rig, measured(truth, rng))
    assert not verdict.plate_matches
    first = verdict.explanations[0]
    assert first.cause.key == what
    assert first.value == pytest.approx(value, rel=within)
    assert first.share > 0.5


def test_diagnose_finds_a_swap_on_another_plate(coarse_rig, monkeypatch):
    """Exchanged channels on a plate with other springs: both are found, of few sizes."""
    monkeypatch.setattr(causes, "_SIZES", (0.82, 1.21))
    rng = np.random.default_rng(13)
    built = measured(changed(coarse_rig, "eras.stiffness"), rng)
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
    few = replace(built, frequencies=FREQUENCIES[:3], values=built.values[:3])
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
    built = measured(longer(within_tolerance(coarse_rig, rng), 1.03), rng)
    plate = sensed_plate(coarse_rig, built.points, built.frequencies)
    match = match_plate(plate, built.values, drives=range(4))
    used = without_outliers(built.values, match.predicted)[-1]
    assert 0.05 < (~used).mean() < MAX_OUTLIERS
    assert match.error > MAX_FIT_ERROR
