"""Tables and queries from Python, against the commands."""

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import era_haptics as era
from model.cli import app

TARGET, QUIET = (0.08, 0.06), [(0.22, 0.16), (0.25, 0.04)]


@pytest.fixture(scope="module")
def table(tmp_path_factory: pytest.TempPathFactory) -> era.LocalizationTable:
    """A small table in a cache of its own."""
    rig = era.load_rig(str(era.example_rig_path()), mesh="12x9")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        return era.table(rig, drive_mode="phased", frequencies=[60, 110, 250], grid=era.Grid(4, 3))


@pytest.mark.parametrize("envelopes", [False, True])
def test_query_equals_the_command(
    table: era.LocalizationTable, tmp_path: Path, envelopes: bool
) -> None:
    """Every measure of `era table query --json`, from the table's file."""
    path = str(tmp_path / "t.npz")
    era.save_table(table, path)
    pattern = era.query(
        era.load_table(path), TARGET, quiet=QUIET, level_db_sl=15, envelopes=envelopes
    )
    options = ["--target", "0.08,0.06", "--quiet", "0.22,0.16", "--quiet", "0.25,0.04"]
    options += ["--level", "15", *(["--envelopes"] if envelopes else [])]
    answer = json.loads(
        CliRunner().invoke(app, ["table", "query", path, *options, "--json"]).stdout
    )
    for measure in (
        *("level_db_sl", "contrast_db", "felt_contrast_db", "robust_contrast_db"),
        *("transient_contrast_db", "residual_db", "quiet_level_db_sl", "usable_level_db_sl"),
    ):
        assert getattr(pattern, measure) == pytest.approx(answer[measure], abs=1e-6), measure
    assert table.drive_of(pattern.excitation) == answer["drive"]
    assert bool(pattern.onset) is envelopes


def test_table_has_the_requested_mode_frequencies_and_grid(table: era.LocalizationTable) -> None:
    """Mode, frequencies and cells."""
    assert table.drive_mode == "phased"
    np.testing.assert_array_equal(table.frequencies, [60.0, 110.0, 250.0])
    assert table.grid == era.Grid(4, 3)


def test_query_converts_numbers_of_numpy(table: era.LocalizationTable) -> None:
    """Single precision becomes float, so that results can be written as JSON."""
    plain, given = (era.query(table, TARGET, level_db_sl=kind(12)) for kind in (float, np.float32))
    assert json.dumps(given.level_db_sl) == json.dumps(plain.level_db_sl)
    amplitudes = {type(tone.amplitude) for tone in given.excitation.values()}
    assert (given.excitation, amplitudes) == (plain.excitation, {float})


def test_results_become_frames(table: era.LocalizationTable) -> None:
    """A row a finger of an answer, a row a point of a map, a row a moment of a playback."""
    answer = era.answer(table, [era.Request(TARGET), era.Request(QUIET[0])])
    frame = answer.to_frame()
    assert list(frame["verdict"]) == [layer.verdict for layer in answer.layers]
    assert frame.loc[1, "x_m"] == QUIET[0][0]
    plate = era.SolvedPlate(era.load_rig(str(era.example_rig_path()), mesh="12x9"))
    field = plate.map({"SW": 110}, raster=(4, 3)).to_frame()
    assert field.shape == (12, 3)
    assert field["peak_m_s2"].min() > 0
    felt = plate.play({"SW": 110}, TARGET, quiet=QUIET, duration=0.3).to_frame()
    assert felt["time_s"].iloc[-1] == pytest.approx(0.3, abs=0.001)
    assert list(felt.columns[1:]) == ["target_1_m_s2", "quiet_1_m_s2", "quiet_2_m_s2"]
