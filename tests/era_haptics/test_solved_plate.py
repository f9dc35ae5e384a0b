"""A plate solved once, against direct solves and another program."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import era_haptics as era
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
    pattern = era.query(table, TARGET, quiet=QUIET, envelopes=envelopes)
    felt = plate.play(pattern, TARGET, quiet=QUIET, duration=1.5)
    assert pattern.contrast_db is not None
    assert pattern.contrast_db > 10
    assert felt.contrast_db == pytest.approx(pattern.contrast_db, abs=0.3)
    assert felt.level_db_sl == pytest.approx(pattern.level_db_sl, abs=0.1)
    assert felt.felt_contrast_db == pytest.approx(pattern.felt_contrast_db, abs=0.3)
    assert felt.quiet_level_db_sl == pytest.approx(pattern.quiet_level_db_sl, abs=0.3)
    assert felt.transient_contrast_db == pytest.approx(pattern.transient_contrast_db, abs=1)
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
