"""Tables, queries and their pictures from Python, against the commands and the figures."""

import json
from pathlib import Path

import numpy as np
import pytest
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from typer.testing import CliRunner

import era_haptics as era
from model.cli import app
from model.table.build import build_table
from paper_plate import make_paper_rig

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
    answer = era.answer(table, [era.Request(TARGET), era.Request(QUIET[0])], drive_mode="phased")
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


TARGET, QUIET = (0.08, 0.06), [(0.22, 0.16), (0.25, 0.04)]
PLATE = era.SolvedPlate(make_paper_rig(12, 9))


def markers(figure: Figure) -> dict[str, str]:
    """Colours of the ERAs' marks, by place in centimetres."""
    (axes, *_) = figure.axes
    return {
        f"{float(line.get_xdata()[0]):.0f},{float(line.get_ydata()[0]):.0f}": to_hex(
            line.get_color()
        )
        for line in axes.lines
        if line.get_marker() == "o"
    }


def test_draw_map_marks_driven_eras() -> None:
    """Red where driven, green elsewhere; the scale ends at the largest value."""
    figure = era.draw_map(PLATE, {"SW": 110, "NE": era.Drive(110, level=0.5)}, title="a diagonal")
    red, green = "#d62728", "#2ca02c"
    assert markers(figure) == {"0,0": red, "30,0": green, "30,23": red, "0,23": green}
    assert figure.axes[0].get_title() == "a diagonal"
    peak = PLATE.map({"SW": 110, "NE": era.Drive(110, level=0.5)}).peak.max() / 9.8
    assert figure.axes[1].get_ylim()[1] == pytest.approx(peak)


def test_draw_pattern_shows_fingers_and_levels() -> None:
    """Circles of 13 mm at the fingers, the promise in the title, levels in decibels."""
    table = build_table(
        PLATE.rig,
        frequencies=np.array([60.0, 110.0, 250.0]),
        grid=era.Grid(4, 3),
        drive_mode="phased",
    )
    pattern = era.query(table, TARGET, quiet=QUIET)
    figure = era.draw_pattern(table, pattern, TARGET, quiet=QUIET)
    axes = figure.axes[0]
    circles = [patch for patch in axes.patches if isinstance(patch, Circle)]
    assert [np.round(circle.center, 6).tolist() for circle in circles] == [
        [8.0, 6.0], [22.0, 16.0], [25.0, 4.0],
    ]  # fmt: skip
    assert {circle.radius for circle in circles} == {1.3}
    assert f"{pattern.robust_felt_contrast_db:.0f} dB" in axes.get_title()
    texts = [text.get_text() for text in axes.texts]
    assert texts.count("quiet") == 2
    assert f"felt\n{pattern.level_db_sl:.0f} dB SL" in texts
    drawn = np.asarray(axes.collections[0].get_array()).reshape(121, 121)
    row, column = round(0.06 / 0.2286 * 120), round(0.08 / 0.3048 * 120)
    assert drawn[row, column] == pytest.approx(pattern.level_db_sl, abs=1.0)


def test_draw_playback_shows_peaks_over_time() -> None:
    """A line for each finger, at the end in the ratio of the steady contrast."""
    played = PLATE.play({"SW": era.Drive(110, level=0.1)}, TARGET, quiet=QUIET, duration=1.2)
    figure = era.draw_playback(played)
    axes = figure.axes[0]
    names = [text.get_text() for text in axes.get_legend().get_texts()]
    assert names == ["target 1", "quiet 1", "quiet 2"]
    lines = dict(zip(names, axes.lines, strict=True))
    assert float(lines["target 1"].get_xdata()[-1]) == pytest.approx(1200.0)
    at_target = float(lines["target 1"].get_ydata()[-1])
    loudest = max(float(lines[name].get_ydata()[-1]) for name in names[1:])
    assert 20 * np.log10(at_target / loudest) == pytest.approx(played.contrast_db, abs=0.1)
    assert f"{played.contrast_db:.1f} dB steady" in axes.get_title()
