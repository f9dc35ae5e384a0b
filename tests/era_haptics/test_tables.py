"""Tables, queries, pictures and amplifiers of a rig from a script, against the commands."""

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from typer.testing import CliRunner

import era_haptics as era
from era_haptics.drive import as_points, layers_of
from model.answer.answer import Layer
from model.cli import app
from model.rig.rig import Channel
from model.table.table_file import build_table
from plates import make_paper_rig

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
    loaded = era.load_table(path)
    found = era.query(loaded, TARGET, quiet=QUIET, level_db_sl=15, shaped=envelopes)
    options = ["--target", "0.08,0.06", "--quiet", "0.22,0.16", "--quiet", "0.25,0.04"]
    options += ["--level", "15", *(["--envelopes"] if envelopes else [])]
    answer = json.loads(
        CliRunner().invoke(app, ["table", "query", path, *options, "--json"]).stdout
    )
    for finger, felt in zip(answer["fingers"], found.fingers, strict=True):
        assert finger["at_m"] == list(felt.finger.at)
        for key in ("verdict", "layer", "contrast_db", "promised_contrast_db", "lowered_db"):
            assert finger[key] == pytest.approx(getattr(felt, key), abs=1e-6), key
    more = era.measures(loaded, found)
    for key in ("transient_contrast_db", "residual_db", "is_imperceptible_to_quiet"):
        assert answer[key] == pytest.approx(getattr(more, key), abs=1e-6), key
    (layer,), (played,) = found.layers, answer["layers"]
    assert table.drive_of(layer.excitation) == played["drive"]
    assert bool(layer.onset) is bool(played["onset"]) is envelopes


def test_query_is_the_answer_to_fingers_that_must_feel_one(table: era.LocalizationTable) -> None:
    """With quiet fingers as positions or with their loads, and for a time."""
    stimulus = era.Stimulus(15.0, duration=0.04, name="any")
    fingers = [era.Finger(at, stimulus, sharing="must") for at in (TARGET, QUIET[1])]
    for quiet in (QUIET[:1], [era.Finger(QUIET[0])]):
        found = era.answer(table, fingers, quiet=quiet)
        same = era.query(
            table, [TARGET, QUIET[1]], quiet=QUIET[:1], level_db_sl=15.0, duration=0.04
        )
        assert found.layers == same.layers
        assert [each.verdict for each in found.fingers][1:] == ["shared", "quiet"]
        assert found.layers[0].ramp == 0.01
    heavy = era.answer(table, fingers, quiet=[era.Finger(QUIET[0], load=3.0)])
    assert heavy.layers != same.layers


def test_table_has_the_requested_mode_frequencies_and_grid(table: era.LocalizationTable) -> None:
    """Mode, frequencies and cells."""
    assert table.drive_mode == "phased"
    np.testing.assert_array_equal(table.frequencies, [60.0, 110.0, 250.0])
    assert table.grid == era.Grid(4, 3)


def test_query_converts_numbers_of_numpy(table: era.LocalizationTable) -> None:
    """Single precision becomes float, so that results can be written as JSON."""
    plain, given = (era.query(table, TARGET, level_db_sl=kind(12)) for kind in (float, np.float32))
    levels = [each.fingers[0].level_db_sl for each in (given, plain)]
    assert json.dumps(levels[0]) == json.dumps(levels[1])
    drive = given.layers[0].excitation
    assert {type(tone.amplitude) for tone in drive.values()} == {float}
    assert drive == plain.layers[0].excitation


def test_results_become_frames(table: era.LocalizationTable) -> None:
    """A row a finger of an answer, a mode, a point of a map, a moment of a playback."""
    fingers = [era.Finger(at, era.Stimulus()) for at in (TARGET, QUIET[0])]
    answer = era.answer(table, fingers, drive_mode="phased")
    frame = answer.to_frame()
    assert list(frame["verdict"]) == [each.verdict for each in answer.fingers]
    assert frame.loc[1, "x_m"] == QUIET[0][0]
    worst = frame["worst_foreign_level_db_sl"]
    assert worst[1] == answer.fingers[1].foreign_level_db_sl
    plate = era.SolvedPlate(era.load_rig(str(era.example_rig_path()), mesh="12x9"))
    modes = plate.modes.to_frame()
    assert modes["frequency_hz"].tolist() == plate.modes.natural_frequencies.tolist()
    assert modes["damping_ratio"].between(0, 1).all()
    field = plate.map({"SW": 110}, raster=(4, 3)).to_frame()
    assert field.shape == (12, 3)
    assert field["peak_m_s2"].min() > 0
    felt = plate.play({"SW": 110}, TARGET, quiet=QUIET).to_frame()
    assert felt["time_s"].iloc[-1] == pytest.approx(1.0, abs=0.001)
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


def test_draw_answer_shows_fingers_and_levels() -> None:
    """Circles of 13 mm at the fingers, the promise in the title, levels in decibels."""
    table = build_table(
        PLATE.rig,
        frequencies=np.array([60.0, 110.0, 250.0]),
        grid=era.Grid(4, 3),
        drive_mode="phased",
    )
    answer = era.query(table, TARGET, quiet=QUIET)
    felt, figure = answer.fingers[0], era.draw_answer(table, answer)
    axes = figure.axes[0]
    circles = [patch for patch in axes.patches if isinstance(patch, Circle)]
    assert [np.round(circle.center, 6).tolist() for circle in circles] == [
        [8.0, 6.0], [22.0, 16.0], [25.0, 4.0],
    ]  # fmt: skip
    assert {circle.radius for circle in circles} == {1.3}
    assert f"{felt.promised_contrast_db:.0f} dB" in axes.get_title()
    texts = [text.get_text() for text in axes.texts]
    assert texts.count("quiet") == 2
    assert f"felt\n{felt.level_db_sl:.0f} dB SL" in texts
    drawn = np.asarray(axes.collections[0].get_array()).reshape(121, 121)
    row, column = round(0.06 / 0.2286 * 120), round(0.08 / 0.3048 * 120)
    assert drawn[row, column] == pytest.approx(felt.level_db_sl, abs=1.0)


def test_draw_contents_colours_each_finger_by_its_content() -> None:
    """The plate under a finger has the hue of its ring; its promise is beside it; a panel each."""
    # At 90 and 120 Hz both fingers are served by all sets of thresholds; at 60 and 120 Hz by one.
    frequencies, grid = np.array([60.0, 90.0, 120.0, 250.0]), era.Grid(4, 3)
    table = build_table(PLATE.rig, frequencies=frequencies, grid=grid, drive_mode="phased")
    answer = era.answer(table, [era.Finger(at, era.Stimulus()) for at in (TARGET, QUIET[0])])
    figure = era.draw_contents(table, answer)
    whole, *alone = figure.axes
    assert len(alone) == len(answer.layers) == 2
    for axes, layer in zip(alone, answer.layers, strict=True):
        assert axes.get_title() == f"{layer.frequency:g} Hz alone"
    rings = [patch for patch in whole.patches if isinstance(patch, Circle)][1::2]
    pixels = np.asarray(whole.images[0].get_array())
    for felt, ring, text in zip(answer.fingers, rings, whole.texts, strict=True):
        (x, y), (rows, columns, _) = felt.finger.at, pixels.shape
        here = pixels[round(y / 0.2286 * (rows - 1)), round(x / 0.3048 * (columns - 1))]
        assert np.argmax(here) == np.argmax(ring.get_edgecolor()[:3])
        assert np.ptp(here) > 0.2
        assert f"{felt.promised_contrast_db:.0f} dB above the others" in text.get_text()


@pytest.mark.parametrize("is_signals", [False, True])
def test_draw_playback_shows_peaks_over_time(is_signals: bool) -> None:
    """A line for each finger, at the end in the ratio of the steady contrast."""
    if is_signals:
        tone = np.outer([0.1, 0, 0, 0], np.sin(2 * np.pi * 110 * np.arange(0, 1.2, 1 / 4000)))
        played = PLATE.play(tone, TARGET, quiet=QUIET, sample_rate=4000)
    else:
        played = PLATE.play({"SW": era.Drive(110, level=0.1)}, TARGET, quiet=QUIET, duration=1.2)
    figure = era.draw_playback(played)
    axes = figure.axes[0]
    names = [text.get_text() for text in axes.get_legend().get_texts()]
    assert names == ["target 1", "quiet 1", "quiet 2"]
    lines = dict(zip(names, axes.lines, strict=True))
    assert float(lines["target 1"].get_xdata()[-1]) == pytest.approx(1200.0, abs=0.3)
    at_target = float(lines["target 1"].get_ydata()[-1])
    loudest = max(float(lines[name].get_ydata()[-1]) for name in names[1:])
    assert 20 * np.log10(at_target / loudest) == pytest.approx(played.contrast_db, abs=0.1)
    assert f"{played.contrast_db:.1f} dB steady" in axes.get_title()


RIG = make_paper_rig(12, 9)
URL = f"sim://{era.example_rig_path()}"


def test_commands_for_follows_the_wiring() -> None:
    """Levels, degrees, and every wired channel by its amplifier; others are silent."""
    wiring = {
        "SW": Channel("a", 1), "SE": Channel("a", 0), "NE": Channel("b", 5), "NW": Channel("b", 2),
    }  # fmt: skip
    rig = replace(RIG, wiring=wiring, amplifiers={"a": "sim://", "b": "sim://"})
    sets = era.commands_for(rig, {"SW": era.Drive(110, level=0.25), "NE": era.Tone(90, 5e-5, -1)})
    found = {
        name: sorted(
            (each.channel, each.frequency, round(each.level, 9), round(each.phase, 3))
            for layer in layers
            for each in layer.tones
        )
        for name, layers in sets.items()
    }
    assert found == {
        "a": [(0, 40.0, 0.0, 0.0), (1, 110, 0.25, 0.0)],
        "b": [(2, 40.0, 0.0, 0.0), (5, 90, 0.5, -57.296)],
    }


def test_open_amplifier_applies_the_limits_of_the_rig() -> None:
    """It plays within the limits and refuses commands beyond them."""
    rig = replace(RIG, limits=replace(RIG.limits, level=0.2))
    with era.open_amplifier(rig, url=URL) as amplifier:
        amplifier.arm()
        (commands,) = era.commands_for(rig, {"SW": era.Drive(110, level=0.2)}).values()
        layer, *silent = amplifier.play(commands, duration=0.05).layers
        assert not any(each.commands for each in silent)
        levels = {command.channel: command.level for command in layer.commands}  # in 1/10000
        assert levels == {0: 2000, 1: 0, 2: 0, 3: 0}
        (commands,) = era.commands_for(rig, {"SW": era.Drive(110, level=0.21)}).values()
        with pytest.raises(era.CommandRefused, match="level"):
            amplifier.apply(commands)


def test_open_amplifier_needs_a_name_when_there_are_several() -> None:
    """No name or an unknown one: the error lists the known names."""
    rig = replace(RIG, amplifiers={"a": "sim://", "b": "sim://"})
    for name in (None, "c"):
        with pytest.raises(era.InputError, match="a, b"):
            era.open_amplifier(rig, name)


def test_layers_of_accepts_frequency_drive_and_tone() -> None:
    """A bare frequency is at full stroke, 100 µm; a Drive in shares and degrees; a Tone is kept.

    Several tones of an ERA are excitations beside the first.
    """
    tone = era.Tone(250.0, 3e-5, 0.1)
    drives = {"SW": 110, "SE": era.Drive(110, level=0.25, phase_deg=-90), "NE": tone}
    assert layers_of(drives, RIG)[0].excitation == {
        "SW": era.Tone(110, 1e-4, 0.0),
        "SE": era.Tone(110, 0.25e-4, -math.pi / 2),
        "NE": tone,
    }
    half = era.Drive(110, level=0.5)
    (layer,) = layers_of({"SW": [half, era.Drive(90, level=0.5)], "SE": [110]}, RIG)
    assert layer.excitations == (
        {"SW": era.Tone(110, 0.5e-4), "SE": era.Tone(110, 1e-4)},
        {"SW": era.Tone(90, 0.5e-4)},
    )


def test_layers_of_converts_numbers_of_numpy() -> None:
    """Of single precision too, which would go on into every command; 110.5 and 0.25 are exact."""
    drive = era.Drive(np.float32(110.5), level=np.float32(0.25), phase_deg=np.float32(0))  # type: ignore[arg-type]
    assert era.Drive(110, level=np.float64(1.0000000000000002)).level == 1  # of divided weights
    tone = layers_of({"SW": drive}, RIG)[0].excitation["SW"]
    assert tone == era.Tone(110.5, 0.25e-4, 0.0)
    assert {type(tone.frequency), type(tone.amplitude), type(tone.phase)} == {float}


@pytest.mark.parametrize(
    ("drives", "message"),
    [
        ({"XX": 110}, "XX'; choose from SW, SE, NE, NW"),
        ({"XX": era.Tone(110, 1e-4)}, "XX'; choose from SW, SE, NE, NW"),
        ({"SW": 0}, "frequency.* got 0 Hz"),
        ({"SW": math.inf}, "frequency.* got inf Hz"),
        ({"SW": "110 Hz"}, "frequency.* got '110 Hz'"),
        ({"SW": [110, -1]}, "frequency.* got -1 Hz"),
        ({"SW": 39.9}, r"frequency of SW must be from 40 to 500 Hz, got 39.9 Hz; .*limits\.freq"),
        ({"SW": (110, 0.5, 90)}, r"got \(110, 0.5, 90\); .*era\.Drive\(110, 0.5, 90\)"),
        ({"SW": era.Tone(110, 1.00001e-4)}, "level of SW.*0.0001 m, got 1.0000[01]"),
        ({"SW": era.Tone(110, math.nan)}, "level of SW.*got nan"),
        ({"SE": 90, "SW": [era.Drive(110, 0.7), era.Drive(250, 0.6)]}, "level of SW.*got 1.29999"),
        (Layer({"SW": era.Tone(110, 1e-4)}).scaled(1), "level of SW.*got 1.122"),
    ],
)
def test_layers_of_refuses_an_invalid_drive(drives: Any, message: str) -> None:
    """Unknown ERAs, frequencies beyond the limits, more than full stroke of one ERA, a tuple."""
    with pytest.raises(era.InputError, match=message):
        layers_of(drives, RIG)


@pytest.mark.parametrize(
    ("level", "phase", "message"),
    [
        (1.000000002, 0, "level.* got 1.000000002"),
        (math.nan, 0, "level.* got nan"),
        (1, math.inf, "phase.* got inf"),
    ],
)
def test_drive_refuses_an_invalid_level_or_phase(level: float, phase: float, message: str) -> None:
    """Beyond full stroke, and not finite."""
    with pytest.raises(era.InputError, match=message):
        era.Drive(110, level=level, phase_deg=phase)


@pytest.mark.parametrize(
    "places",
    [(0.1, 0.2), [0.1, 0.2], [(0.1, 0.2)], np.array([0.1, 0.2]), np.array([[0.1, 0.2]])],
)
def test_as_points_reads_one_place(places: object) -> None:
    """One alone or in a list, as an array or not."""
    assert as_points(places, what="target") == ((0.1, 0.2),)


def test_as_points_reads_several_places_or_none() -> None:
    """A list of places keeps their order, and any empty one, an array too, is no place."""
    assert as_points([(0.1, 0.2), (0.3, 0.1)], what="quiet") == ((0.1, 0.2), (0.3, 0.1))
    for nothing in ((), [], np.empty((0, 2))):
        assert as_points(nothing, what="quiet") == ()


@pytest.mark.parametrize("places", [(0.1,), (0.1, 0.2, 0.3), "SW", [(0.1, 0.2), (0.3,)], 0.1, None])
def test_as_points_refuses_other_values(places: object) -> None:
    """The error names the argument."""
    with pytest.raises(era.InputError, match="target"):
        as_points(places, what="target")
