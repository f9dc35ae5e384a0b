"""A plate solved once, calibrated and designed from Python, against direct solves."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import era_haptics as era
from model.design import problem
from model.structure.attachments import PointLoad
from model.vibration.maps import plate_map
from paper_plate import make_paper_rig

TARGET, QUIET = (0.08, 0.06), [(0.22, 0.16)]


@pytest.fixture(scope="module")
def plate() -> era.SolvedPlate:
    """The paper's plate on the mesh of the example."""
    return era.SolvedPlate(era.load_rig(era.example_rig_path()))


@pytest.fixture(scope="module")
def table(plate: era.SolvedPlate) -> era.LocalizationTable:
    """Of the same plate, at a few frequencies."""
    from model.table.build import build_table

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
    for seed in (None, 1, 1, 2):
        drawn = era.SolvedPlate(replace(plate.rig, fingertip=None), seed=seed)
        (felt,) = drawn.play(drive, at, duration=2.0).targets
        centre = np.argmin(np.linalg.norm(felt.points - at, axis=1))
        peak = np.abs(felt.accelerations[-2000:, centre]).max()
        assert peak == pytest.approx(drawn.map(drive, raster=(33, 25)).peak[6, 8], rel=0.02)
        peaks.append(peak)
    assert peaks[1] == peaks[2]
    assert len({round(peak, 3) for peak in peaks}) == 3
    known = replace(plate.rig, uncertainty=era.Uncertainty.none())
    first, second = (
        era.SolvedPlate(known, seed=seed).play(drive, TARGET, duration=2.0).level_db_sl
        for seed in (None, 3)
    )
    assert second == pytest.approx(first, abs=0.05)
    for wrong in (-1, 0.5, "1"):
        with pytest.raises(era.InputError, match="seed"):
            era.SolvedPlate(plate.rig, seed=wrong)  # type: ignore[arg-type]


MEASURED = Path(__file__).parents[2] / "examples" / "measured.csv"


def test_map_has_complex_fields_whose_magnitudes_are_the_peak() -> None:
    """Of two frequencies; a drive of another phase turns its own field by that phase."""
    plate = era.SolvedPlate(era.load_rig(era.example_rig_path()))
    drive = {"SW": era.Drive(110, level=0.5), "NE": era.Drive(150, level=0.2)}
    found = plate.map(drive, raster=(7, 5))
    assert found.frequencies.tolist() == [110, 150]
    assert found.field.shape == (2, 5, 7)
    np.testing.assert_allclose(np.abs(found.field).sum(axis=0), found.peak)
    turned = plate.map({"SW": era.Drive(110, level=0.5, phase_deg=90)}, raster=(7, 5))
    np.testing.assert_allclose(turned.field[0], 1j * found.field[0], rtol=1e-9)


@pytest.mark.long
def test_calibrate_finds_the_values_of_the_example() -> None:
    """Loss factor 0.013 and SW at 19.04 kN/m, as examples/make_measured.py has them."""
    found = era.calibrate(era.load_rig(era.example_rig_path()), MEASURED)
    assert found.is_good
    assert found.rig.plate.loss_factor == pytest.approx(0.013, rel=0.01)
    assert found.rig.era("SW").stiffness == pytest.approx(19040, rel=0.02)
    assert found.rig.uncertainty.thickness < 0.005


def test_design_ranks_given_layouts_by_contrast(monkeypatch: pytest.MonkeyPatch) -> None:
    """Judged ones first, in the order of their contrast, then by score, unsupported ones last."""
    monkeypatch.setattr(problem, "JUDGED_SETS", 3)
    monkeypatch.setattr(problem, "SEARCH_FINGERS", 6)
    found = era.design(make_paper_rig(12, 9), layouts="random:8", finalists=2).layouts
    assert len(found) == 8
    contrasts = [each.contrast for each in found]
    assert contrasts[2:] == [None] * 6
    assert contrasts[0] >= contrasts[1]
    scores = [each.expected_contrast for each in found[2:] if each.expected_contrast is not None]
    assert scores == sorted(scores, reverse=True)
    assert all(len(each.eras) == 4 for each in found)


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
    ],
)
def test_design_refuses(wrong: dict[str, object]) -> None:
    """Too few ERAs, no whole number, no layouts, no file, no finalists, too low a mode, a word."""
    with pytest.raises(era.InputError):
        era.design(make_paper_rig(12, 9), **wrong)  # type: ignore[arg-type]
