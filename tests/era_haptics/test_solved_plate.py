"""A plate solved once, calibrated and designed from Python, against direct solves."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import era_haptics as era
from era_haptics.lab.design import problem
from model.structure.attachments import PointLoad
from model.vibration import plate_map
from plates import make_paper_rig

TARGET, QUIET = (0.08, 0.06), [(0.22, 0.16)]


@pytest.fixture(scope="module")
def plate() -> era.SolvedPlate:
    """The paper's plate on the mesh of the example."""
    return era.SolvedPlate(era.load_rig(era.example_rig_path()))


@pytest.fixture(scope="module")
def table(plate: era.SolvedPlate) -> era.LocalizationTable:
    """Of the same plate, at a few frequencies."""
    from model.table.table_file import build_table

    frequencies = np.array([60.0, 110.0, 180.0, 250.0])
    return build_table(plate.rig, frequencies=frequencies, grid=era.Grid(4, 3), drive_mode="phased")


def test_solved_plate_map_equals_direct_solve() -> None:
    """Of a plate that carries a mass, at two frequencies, within 1e-4 of the largest."""
    rig = replace(make_paper_rig(24, 18), masses=(PointLoad(0.1, 0.1, mass=0.02),))
    drive = {"SW": 110, "NE": era.Drive(110, level=0.5, phase_deg=90), "SE": era.Tone(250, 2e-5)}
    excitation = {
        "SW": era.Tone(110, 1e-4),
        "NE": era.Tone(110, 0.5e-4, np.pi / 2),
        "SE": era.Tone(250, 2e-5),
    }
    found = era.SolvedPlate(rig).map(drive, raster=(13, 9))
    direct = plate_map(rig, excitation, raster=(13, 9))
    np.testing.assert_array_equal(found.x, np.linspace(0, 0.3048, 13))
    np.testing.assert_allclose(found.peak, direct.peak, atol=1e-4 * direct.peak.max())


@pytest.mark.parametrize("raster", [[5, 4], np.array([5, 4]), (np.int64(5), 4)])
def test_solved_plate_map_accepts_sequences_as_raster(plate: era.SolvedPlate, raster: Any) -> None:
    """Five columns, four rows: a list, an array, and a number of numpy's."""
    assert plate.map({"SW": 110}, raster=raster).peak.shape == (4, 5)


@pytest.mark.parametrize("envelopes", [False, True])
def test_solved_plate_play_feels_what_was_predicted(
    plate: era.SolvedPlate, table: era.LocalizationTable, envelopes: bool
) -> None:
    """Steady and transient measures of a query against the plant in time."""
    answer = era.query(table, TARGET, quiet=QUIET, shaped=envelopes)
    felt, predicted = plate.play(answer, TARGET, quiet=QUIET, duration=1.5), answer.fingers[0]
    assert predicted.contrast_db is not None
    assert predicted.contrast_db > 10
    assert felt.level_db_sl == pytest.approx(predicted.level_db_sl, abs=0.1)
    assert felt.contrast_db == pytest.approx(predicted.contrast_db, abs=0.3)
    transient = era.measures(table, answer).transient_contrast_db
    assert felt.transient_contrast_db == pytest.approx(transient, abs=1)
    assert felt.settled == (0.04 if not envelopes else pytest.approx(0.105))


def test_solved_plate_refuses_frequencies_beyond_its_limits(plate: era.SolvedPlate) -> None:
    """Beyond the rig's limits, with a remedy."""
    for ask in (plate.map, lambda drive: plate.play(drive, TARGET)):
        with pytest.raises(era.InputError, match=r"500 Hz.*limits\.frequency"):
            ask({"SW": 501})


def test_solved_plate_with_a_seed_is_another_one(plate: era.SolvedPlate) -> None:
    """Map and playback are of one plate, drawn by the seed; it is not the rig's, nor another's.

    Where the rig is known exactly, any seed gives the same response on another mesh.
    """
    drive = {"SW": 110, "NE": era.Drive(110, level=0.5, phase_deg=90)}
    at, peaks = (8 * 0.3048 / 32, 6 * 0.2286 / 24), []  # a point of the raster
    pure = replace(plate.rig.uncertainty, harmonic=0.0)  # which a map has not
    for seed in (None, 1, 1, 2):
        drawn = era.SolvedPlate(replace(plate.rig, fingertip=None, uncertainty=pure), seed=seed)
        (felt,) = drawn.play(drive, at).targets
        centre = np.argmin(np.linalg.norm(felt.points - at, axis=1))
        peak = np.abs(felt.accelerations[-2000:, centre]).max()
        assert peak == pytest.approx(drawn.map(drive, raster=(33, 25)).peak[6, 8], rel=0.02)
        peaks.append(peak)
    assert peaks[1] == peaks[2]
    assert len({round(peak, 3) for peak in peaks}) == 3
    known = replace(plate.rig, uncertainty=era.Uncertainty.none())
    first, second = (
        era.SolvedPlate(known, seed=seed).play(drive, TARGET).level_db_sl for seed in (None, 3)
    )
    assert second == pytest.approx(first, abs=0.05)
    for wrong in (-1, 0.5, "1"):
        with pytest.raises(era.InputError, match="seed"):
            era.SolvedPlate(plate.rig, seed=wrong)  # type: ignore[arg-type]


@pytest.mark.parametrize("seed", [None, 1])
def test_responses_times_weights_are_a_map(seed: int | None) -> None:
    """To 1e-6, at two frequencies, of a plate that carries a mass, and of a drawn one."""
    rig = replace(make_paper_rig(12, 9), masses=(PointLoad(0.1, 0.1, mass=0.02),))
    plate = era.SolvedPlate(rig, seed=seed)
    found = plate.map(
        {"SW": 110, "NE": era.Drive(110, 0.5, 90), "SE": era.Drive(250, 0.2)}, raster=(5, 4)
    )
    points = np.stack(np.meshgrid(found.x, found.y), axis=-1).reshape(-1, 2)
    fields = era.SolvedPlate(rig).responses(points, [110, 250], seed=seed)
    assert fields.shape == (2, 4, 20)
    weights = np.array([[1, 0, 0.5j, 0], [0, 0.2, 0, 0]])  # SW, SE, NE, NW
    expected = found.field.reshape(2, 20)
    np.testing.assert_allclose(
        (weights[:, None] @ fields)[:, 0], expected, atol=1e-6 * np.abs(expected).max()
    )


def test_responses_of_drawn_plates_deviate_as_the_uncertainty(plate: era.SolvedPlate) -> None:
    """Where gains alone are uncertain: by 5 % and 5 degrees, of all channels together by 20 %."""
    known = era.Uncertainty(0.05, 5.0, 0.0, 0.0, 1.0, 0.0, common_gain=0.2)
    plate = era.SolvedPlate(replace(plate.rig, uncertainty=known))
    nominal = plate.responses(TARGET, [110.0])[0, :, 0]
    logs = np.log([plate.responses(TARGET, [110.0], seed=n)[0, :, 0] for n in range(40)] / nominal)
    assert logs.imag.std() == pytest.approx(np.radians(5), rel=0.2)
    assert logs.real.mean(axis=1).std() == pytest.approx(0.2, rel=0.25)
    assert (logs.real.T - logs.real.mean(axis=1)).std() == pytest.approx(0.05, rel=0.25)


RATE, COUNT = 10_000.0, 13_000
SIGNAL = np.sin(2 * np.pi * 333.3 * np.arange(COUNT) / RATE + np.radians(20))


@pytest.mark.parametrize("seed", [None, 2])
def test_signals_of_a_ramped_tone_are_felt_as_the_drive(
    plate: era.SolvedPlate, seed: int | None
) -> None:
    """Under two fingers: acceleration to 1e-4 of its peak, where the ramp bends, later to 1e-6.

    And to 2 % in the last samples: a signal that is cut has no band. An error of phase, which a
    drawn channel has at all frequencies alike, is not causal: then to 2 % anywhere. The measures
    are the same.
    """
    pure = replace(plate.rig.uncertainty, harmonic=0.0)  # which signals have not
    drawn = era.SolvedPlate(replace(plate.rig, uncertainty=pure), seed=seed)
    signals = np.zeros((4, COUNT))
    ramp = (1 - np.cos(np.pi * np.minimum(np.arange(COUNT) / 400, 1))) / 2  # 40 ms
    signals[2] = 0.7 * ramp * SIGNAL  # NE
    played = drawn.play(signals, TARGET, quiet=QUIET, sample_rate=RATE)
    drive = {"NE": era.Drive(333.3, level=0.7, phase_deg=20)}
    other = drawn.play(drive, TARGET, quiet=QUIET, duration=COUNT / RATE)
    for ours, theirs in zip(
        (*played.targets, *played.quiet), (*other.targets, *other.quiet), strict=True
    ):
        np.testing.assert_allclose(ours.times[1:], theirs.times[: COUNT - 1])
        differ = np.abs(ours.accelerations[1:] - theirs.accelerations[: COUNT - 1]).max(axis=1)
        peak = np.abs(theirs.accelerations).max()
        assert differ.max() < 2e-2 * peak
        if seed is None:
            assert differ[:-500].max() < 1e-4 * peak
            assert differ[1000:-500].max() < 1e-6 * peak
    assert played.level_db_sl == pytest.approx(other.level_db_sl, abs=0.05)
    assert played.contrast_db == pytest.approx(other.contrast_db, abs=0.01)
    assert played.transient_contrast_db == pytest.approx(other.transient_contrast_db, abs=1e-3)


def test_signals_settle_at_the_responses() -> None:
    """Amplitude and phase of a tone, to 1e-5 where the plate itself loses nothing.

    Its loss is hysteretic in one and viscous in the other; ERAs and fingers lose enough to settle.
    """
    rig = era.load_rig(era.example_rig_path())
    plate = era.SolvedPlate(replace(rig, plate=replace(rig.plate, loss_factor=0.0)))
    signals = np.array([[0.5], [0.0], [-0.3], [0.0]]) * SIGNAL
    played = plate.play(signals, TARGET, quiet=QUIET, sample_rate=RATE)
    for record in (*played.targets, *played.quiet):
        late = slice(COUNT - 3000, COUNT - 600)
        angles = 2 * np.pi * 333.3 * record.times[late]
        basis = np.column_stack([np.sin(angles), np.cos(angles)])
        sine, cosine = np.linalg.lstsq(basis, record.accelerations[late])[0]
        fields = plate.responses(record.points, [333.3], fingers=[TARGET, *QUIET])[0]
        expected = np.exp(1j * np.radians(20)) * np.array([0.5, 0, -0.3, 0]) @ fields
        np.testing.assert_allclose(sine + 1j * cosine, expected, atol=1e-5 * abs(expected).max())


def test_play_lasts_until_it_is_steady(plate: era.SolvedPlate) -> None:
    """The least duration that is accepted is right to 0.3 dB where 0.1 s, refused, is 7 dB off."""
    weak = {"SW": 40}
    with pytest.raises(era.InputError, match=r"at least 0.5\d* s.*got 0.1 s"):
        plate.play(weak, TARGET, quiet=QUIET, duration=0.1)
    shortest, default, long = (
        plate.play(weak, TARGET, quiet=QUIET, duration=each).level_db_sl for each in (0.53, None, 3)
    )
    assert shortest == pytest.approx(long, abs=0.3)
    assert default == pytest.approx(long, abs=0.05)


@pytest.mark.parametrize("quiet", [[], QUIET])
def test_signals_of_silence_have_no_contrast(plate: era.SolvedPlate, quiet: Any) -> None:
    """Nothing is felt, without a warning of numpy's, beside a quiet finger, too.

    What exceeds full stroke by rounding is full stroke.
    """
    loud = [np.full((4, 60), level) for level in (1, 1 + 5e-10)]
    first, second = (plate.play(each, TARGET, sample_rate=4000).level_db_sl for each in loud)
    assert first == second
    played = plate.play(np.zeros((4, 60)), TARGET, quiet=quiet, sample_rate=4000)
    assert played.level_db_sl == -np.inf
    assert (played.contrast_db, played.transient_contrast_db) == (None, None)


@pytest.mark.parametrize(
    ("signals", "rate", "says"),
    [
        (np.zeros((3, 300)), 3000, r"SW, SE, NE, NW, got shape \(3, 300\)"),
        (np.zeros((4, 300)) + 0j, 3000, "real numbers"),
        (np.full((4, 300), np.nan), 3000, "-1 to 1, got nan of SW at sample 0"),
        (np.eye(4, 300) * 1.00000001, 3000, "-1 to 1, got 1.00000001 of SW at sample 0"),
        (np.zeros((4, 300)), 1000, "above 1000 Hz"),
        (np.zeros((4, 300)), None, "sample_rate"),
        (np.zeros((4, 30)), 6000, "last from 0.01 to 10 s, got 0.005"),
        (np.zeros((4, 3000)), 200, "above 1000 Hz"),
        ({"SW": 110}, 3000, "got a dict"),
    ],
)
def test_signals_that_no_era_plays_are_refused(
    plate: era.SolvedPlate, signals: Any, rate: Any, says: str
) -> None:
    """By shape, kind, value, rate and length, with the place of a value."""
    with pytest.raises(era.InputError, match=says):
        plate.play(signals, TARGET, sample_rate=rate)


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ({"points": [(9.0, 0.1)]}, "point"),
        ({"points": TARGET, "fingers": [(0.1, 9.0)]}, "finger"),
        ({"points": TARGET, "fingers": [era.Finger(TARGET, load=99.0)]}, "load"),
        ({"points": TARGET, "frequencies": [600]}, r"500 Hz.*limits\.frequency"),
        ({"points": TARGET, "frequencies": []}, "frequencies must be"),
        ({"points": TARGET, "frequencies": [np.nan]}, "frequency"),
    ],
)
def test_responses_refuse(plate: era.SolvedPlate, wrong: dict[str, Any], says: str) -> None:
    """Places off the plate, a load that no finger has, and frequencies out of range."""
    with pytest.raises(era.InputError, match=says):
        plate.responses(**wrong)


MEASURED = Path(__file__).parents[2] / "examples" / "measured.csv"


def test_map_has_complex_fields_whose_magnitudes_are_the_peak() -> None:
    """Of two frequencies; a drive of another phase turns its own field, several of one add up."""
    plate = era.SolvedPlate(era.load_rig(era.example_rig_path()))
    drive = {"SW": era.Drive(110, level=0.5), "NE": era.Drive(150, level=0.2)}
    found = plate.map(drive, raster=(7, 5))
    assert found.frequencies.tolist() == [110, 150]
    assert found.field.shape == (2, 5, 7)
    np.testing.assert_allclose(np.abs(found.field).sum(axis=0), found.peak)
    turned = plate.map({"SW": era.Drive(110, level=0.5, phase_deg=90)}, raster=(7, 5))
    np.testing.assert_allclose(turned.field[0], 1j * found.field[0], rtol=1e-9)
    parts = [era.Drive(110, level=0.2), era.Drive(110, level=0.3)]
    added = plate.map({"SW": parts}, raster=(7, 5))
    np.testing.assert_allclose(added.field[0], found.field[0], rtol=1e-9)


@pytest.mark.long
def test_calibrate_finds_the_values_of_the_example() -> None:
    """Loss factor 0.013 and SW at 19.04 kN/m, as examples/make_measured.py has them."""
    found = era.calibrate(era.load_rig(era.example_rig_path()), MEASURED)
    assert found.is_good
    assert found.rig.plate.loss_factor == pytest.approx(0.013, rel=0.01)
    assert found.rig.era("SW").stiffness == pytest.approx(19040, rel=0.02)
    assert found.rig.uncertainty.thickness < 0.005
    frame = found.to_frame().set_index("parameter")
    assert frame.loc["SW stiffness", "after"] == found.rig.era("SW").stiffness
    assert frame.loc["SW stiffness", ["before", "unit"]].tolist() == [17000.0, "N/m"]


def test_design_ranks_given_layouts_by_contrast(monkeypatch: pytest.MonkeyPatch) -> None:
    """Judged ones first, in the order of their contrast, then by score, unsupported ones last."""
    monkeypatch.setattr(problem, "JUDGED_SETS", 3)
    monkeypatch.setattr(problem, "SEARCH_FINGERS", 6)
    designed = era.design(make_paper_rig(12, 9), layouts="random:8", finalists=2)
    found = designed.layouts
    assert len(found) == 8
    contrasts = [each.contrast for each in found]
    assert contrasts[2:] == [None] * 6
    assert contrasts[0] >= contrasts[1]
    scores = [each.expected_contrast for each in found[2:] if each.expected_contrast is not None]
    assert scores == sorted(scores, reverse=True)
    assert all(len(each.eras) == 4 for each in found)
    best = f"{found[0].name}, 4 ERAs, {contrasts[0]:.1f} dB"
    assert repr(designed) == f"<Design of 8 layouts: {best}>"


@pytest.mark.parametrize(
    "wrong",
    [
        {"eras": 2},
        {"eras": 4.5},
        {"layouts": "random:0"},
        {"layouts": "nosuch.yaml"},
        {"layouts": "random:3", "finalists": 0},
        {"lowest": 0.5},
        {"apart": "wide"},
        {"eras": "six"},
        {"where": "middle"},
    ],
)
def test_design_refuses(wrong: dict[str, object]) -> None:
    """Arguments are named as they are given, not as flags of the command."""
    with pytest.raises(era.InputError) as refused:
        era.design(make_paper_rig(12, 9), **wrong)  # type: ignore[arg-type]
    assert "--" not in str(refused.value)
