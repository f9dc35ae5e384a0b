"""A plate that is solved once, against direct solutions and against what answers promise."""

import math
from dataclasses import replace

import numpy as np
import pytest

import era_haptics as era
from kit.plates import make_paper_rig
from model.structure.attachments import PointLoad
from model.vibration import plate_map

TARGET = (0.08, 0.06)
QUIET = [(0.22, 0.16)]
RIG = era.load_rig(era.example_rig_path())
PLATE = era.SolvedPlate(RIG)
CAMERA = PointLoad(0.1, 0.1, mass=0.02)


# Maps


def test_map_equals_a_direct_solution() -> None:
    """For a plate with a mass and two frequencies, within 1e-4 of the largest amplitude."""
    rig = replace(make_paper_rig(24, 18), masses=(CAMERA,))
    drive = {"SW": 110, "NE": era.Drive(110, level=0.5, phase_deg=90), "SE": era.Tone(250, 2e-5)}
    excitation = {
        "SW": era.Tone(110, 1e-4),
        "NE": era.Tone(110, 0.5e-4, np.pi / 2),
        "SE": era.Tone(250, 2e-5),
    }

    solved = era.SolvedPlate(rig).map(drive, raster=(13, 9))

    direct = plate_map(rig, excitation, raster=(13, 9))
    np.testing.assert_array_equal(solved.x, np.linspace(0, 0.3048, 13))
    np.testing.assert_allclose(solved.peak, direct.peak, atol=1e-4 * direct.peak.max())


@pytest.mark.parametrize("seed", [None, 1])
def test_responses_weighted_by_a_drive_are_its_map(seed: int | None) -> None:
    """Within 1e-6, for a plate with a mass, and for a drawn one."""
    rig = replace(make_paper_rig(12, 9), masses=(CAMERA,))
    drive = {"SW": 110, "NE": era.Drive(110, 0.5, 90), "SE": era.Drive(250, 0.2)}
    weights = np.array([[1, 0, 0.5j, 0], [0, 0.2, 0, 0]])  # SW, SE, NE, NW

    plate = era.SolvedPlate(rig, seed=seed)
    plate_field = plate.map(drive, raster=(5, 4))
    columns, rows = np.meshgrid(plate_field.x, plate_field.y)
    points = np.column_stack([columns.ravel(), rows.ravel()])
    responses = era.SolvedPlate(rig).responses(points, [110, 250], seed=seed)

    assert responses.shape == (2, 4, 20)
    expected = plate_field.field.reshape(2, 20)
    weighted = np.einsum("fe,fep->fp", weights, responses)
    np.testing.assert_allclose(weighted, expected, atol=1e-6 * np.abs(expected).max())


def test_sweep_is_the_map_of_its_drive_at_each_frequency() -> None:
    """As a table, too; unknown ERAs and more than full stroke are rejected."""
    rig = make_paper_rig(12, 9)
    plate = era.SolvedPlate(rig)
    points = [(0.0, 0.0), (rig.plate.length, rig.plate.width)]

    swept = plate.sweep({"SW": 1, "NE": 0.5j}, points, [110, 250])

    for number, hertz in enumerate((110, 250)):
        field = plate.map({"SW": hertz, "NE": era.Drive(hertz, 0.5, 90)}, raster=(2, 2)).field[0]
        corners = [field[0, 0], field[1, 1]]
        np.testing.assert_allclose(swept.acceleration[number], corners, rtol=1e-6)
    frame = swept.to_frame()
    assert frame.frequency_hz.tolist() == [110, 110, 250, 250]
    assert frame.x_m.tolist() == [0.0, rig.plate.length] * 2
    np.testing.assert_allclose(frame.peak_m_s2, np.abs(swept.acceleration).ravel())
    with pytest.raises(era.InputError, match="unknown ERA"):
        plate.sweep({"XX": 1}, points)
    with pytest.raises(era.InputError, match="weight of SW must be at most 1"):
        plate.sweep({"SW": 1.1}, points)


# Playback


@pytest.mark.parametrize(("is_shaped", "settled"), [(False, 0.04), (True, 0.105)])
def test_play_of_an_answer_feels_what_the_table_predicts(
    table: era.LocalizationTable, is_shaped: bool, settled: float
) -> None:
    """Level and contrast, steady and while it starts, of the plant over time."""
    answer = era.query(table, TARGET, quiet=QUIET, shaped=is_shaped)
    predicted = answer.fingers[0]
    assert predicted.contrast_db > 10

    felt = PLATE.play(answer, TARGET, quiet=QUIET, duration=1.5)

    assert felt.level_db_sl == pytest.approx(predicted.level_db_sl, abs=0.1)
    assert felt.contrast_db == pytest.approx(predicted.contrast_db, abs=0.3)
    transient_contrast = era.measures(table, answer).transient_contrast_db
    assert felt.transient_contrast_db == pytest.approx(transient_contrast, abs=1)
    assert felt.settled == pytest.approx(settled)


def test_play_lasts_until_the_vibration_is_steady() -> None:
    """The shortest duration that is accepted is right within 0.3 dB."""
    weak = {"SW": 40}
    shortest = PLATE.play(weak, TARGET, quiet=QUIET, duration=0.53).level_db_sl
    default = PLATE.play(weak, TARGET, quiet=QUIET).level_db_sl
    long = PLATE.play(weak, TARGET, quiet=QUIET, duration=3).level_db_sl

    assert shortest == pytest.approx(long, abs=0.3)
    assert default == pytest.approx(long, abs=0.05)


RATE = 10_000.0  # Hz
COUNT = 13_000
"""Samples of a signal."""


@pytest.mark.parametrize("seed", [None, 2])
def test_play_of_a_signal_is_felt_as_the_same_drive(seed: int | None) -> None:
    """A tone with a ramp of 40 ms, under two fingers, within 1e-4 of the peak, later 1e-6.

    Within 2 % in the last samples, since a signal that is cut off has no band. A drawn plate has a
    phase error that is equal at all frequencies, hence not causal: within 2 % everywhere.
    """
    without_harmonics = replace(RIG.uncertainty, harmonic=0.0)  # signals have none
    plate = era.SolvedPlate(replace(RIG, uncertainty=without_harmonics), seed=seed)
    sample = np.arange(COUNT)
    rise = np.minimum(sample / 400, 1)
    ramp = (1 - np.cos(np.pi * rise)) / 2
    angle = 2 * np.pi * 333.3 * sample / RATE
    tone = np.sin(angle + np.radians(20))
    signals = np.zeros((4, COUNT))
    signals[2] = 0.7 * ramp * tone  # NE
    drive = {"NE": era.Drive(333.3, level=0.7, phase_deg=20)}

    of_signal = plate.play(signals, TARGET, quiet=QUIET, sample_rate=RATE)
    of_drive = plate.play(drive, TARGET, quiet=QUIET, duration=COUNT / RATE)

    signal_records = (*of_signal.targets, *of_signal.quiet)
    drive_records = (*of_drive.targets, *of_drive.quiet)
    for signal_record, drive_record in zip(signal_records, drive_records, strict=True):
        accelerations = drive_record.accelerations
        expected = accelerations[: COUNT - 1]
        np.testing.assert_allclose(signal_record.times[1:], drive_record.times[: COUNT - 1])
        differences = np.abs(signal_record.accelerations[1:] - expected)
        relative = differences.max(axis=1) / np.abs(accelerations).max()
        assert relative.max() < 2e-2
        if seed is None:
            assert relative[:-500].max() < 1e-4
            assert relative[1000:-500].max() < 1e-6
    assert of_signal.level_db_sl == pytest.approx(of_drive.level_db_sl, abs=0.05)
    assert of_signal.contrast_db == pytest.approx(of_drive.contrast_db, abs=0.01)
    transient_contrast = of_drive.transient_contrast_db
    assert of_signal.transient_contrast_db == pytest.approx(transient_contrast, abs=1e-3)


# Plates drawn from the tolerances


def peak_at(plate: era.SolvedPlate, point: tuple[float, float]) -> float:
    """Return the steady peak acceleration at a point, from a playback."""
    drive = {"SW": 110, "NE": era.Drive(110, level=0.5, phase_deg=90)}
    (felt,) = plate.play(drive, point).targets
    distances = np.linalg.norm(felt.points - point, axis=1)
    steady = felt.accelerations[-2000:, distances.argmin()]
    return float(np.abs(steady).max())


def test_solved_plate_with_a_seed_is_one_drawn_plate() -> None:
    """Map and playback agree; another seed, or none, gives another plate."""
    point = (8 * 0.3048 / 32, 6 * 0.2286 / 24)  # of the raster
    without_harmonics = replace(RIG.uncertainty, harmonic=0.0)  # maps have none
    rig = replace(RIG, fingertip=None, uncertainty=without_harmonics)
    drive = {"SW": 110, "NE": era.Drive(110, level=0.5, phase_deg=90)}
    peaks = []
    for seed in (None, 1, 2):
        plate = era.SolvedPlate(rig, seed=seed)
        peak = peak_at(plate, point)
        plate_field = plate.map(drive, raster=(33, 25))
        assert peak == pytest.approx(plate_field.peak[6, 8], rel=0.02), seed
        peaks.append(peak)

    assert peak_at(era.SolvedPlate(rig, seed=1), point) == peaks[1]
    assert len({round(peak, 3) for peak in peaks}) == 3


# Refusals


SILENCE = np.zeros((4, 300))
REFUSED_SIGNALS = {
    "three ERAs": (SILENCE[:3], 3000, r"SW, SE, NE, NW, got shape \(3, 300\)"),
    "complex": (SILENCE + 0j, 3000, "real numbers"),
    "not a number": (SILENCE + np.nan, 3000, "-1 to 1, got nan of SW at sample 0"),
    "too large": (np.eye(4, 300) * 1.00000001, 3000, "got 1.00000001 of SW at sample 0"),
    "low rate": (SILENCE, 1000, "above 1000 Hz"),
    "no rate": (SILENCE, None, "sample_rate"),
    "short": (SILENCE[:, :30], 6000, "last from 0.01 to 10 s, got 0.005"),
    "drive": ({"SW": 110}, 3000, "got a dict"),
}


@pytest.mark.parametrize("case", REFUSED_SIGNALS)
def test_play_refuses_a_signal(case: str) -> None:
    """Its shape, type, values, rate or length, with the place of a value."""
    signals, rate, message = REFUSED_SIGNALS[case]
    with pytest.raises(era.InputError, match=message):
        PLATE.play(signals, TARGET, sample_rate=rate)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"points": [(9.0, 0.1)]}, "point"),
        ({"points": TARGET, "fingers": [era.Finger(TARGET, load=99.0)]}, "load"),
        ({"points": TARGET, "frequencies": [600]}, r"500 Hz.*limits\.frequency"),
        ({"points": TARGET, "frequencies": []}, "frequencies must be"),
    ],
    ids=["off the plate", "load", "frequency", "no frequency"],
)
def test_responses_refuse_an_argument(arguments: dict[str, object], message: str) -> None:
    """A point off the plate, a load that no finger has, and frequencies."""
    with pytest.raises(era.InputError, match=message):
        PLATE.responses(**arguments)  # type: ignore[arg-type]


@pytest.mark.parametrize("seed", [-1, 0.5, "1", math.inf])
def test_solved_plate_refuses_a_seed(seed: object) -> None:
    """A seed is a natural number."""
    with pytest.raises(era.InputError, match="seed"):
        era.SolvedPlate(RIG, seed=seed)  # type: ignore[arg-type]
