"""Tables, queries, designs, pictures and amplifiers of a rig from a script."""

import json
import math
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.patches import Circle
from typer.testing import CliRunner

import era_haptics as era
from era_haptics.drive import playable_layers
from kit.plates import make_paper_rig
from model.answer.answer import Layer
from model.cli import app
from model.drive_modes import playable_drive_modes
from model.rig.rig import Channel

TARGET = (0.08, 0.06)
QUIET = (0.22, 0.16)
OTHER_QUIET = (0.25, 0.04)
RIG = era.load_rig(era.example_rig_path())
PLATE = era.SolvedPlate(RIG)


# Calibration and design


@pytest.mark.long
def test_calibrate_finds_the_values_of_the_example() -> None:
    """Loss factor 0.013 and SW at 19.04 kN/m, as in examples/make_measured.py."""
    measured = era.example_rig_path().parent / "measured.csv"

    calibration = era.calibrate(RIG, measured)

    assert calibration.is_good
    assert calibration.rig.plate.loss_factor == pytest.approx(0.013, rel=0.01)
    stiffness = calibration.rig.era("SW").stiffness
    assert stiffness == pytest.approx(19040, rel=0.02)
    assert calibration.rig.uncertainty.thickness < 0.005
    row = calibration.to_frame().set_index("parameter").loc["SW stiffness"]
    assert row["before"] == 17000.0
    assert row["after"] == stiffness
    assert row["unit"] == "N/m"


@pytest.mark.parametrize(
    "arguments",
    [
        {"eras": 2},
        {"eras": 4.5},
        {"eras": "six"},
        {"layouts": "random:0"},
        {"layouts": "nosuch.yaml"},
        {"layouts": "random:3", "finalists": 0},
        {"lowest": 0.5},
        {"apart": "wide"},
        {"where": "middle"},
    ],
    ids=str,
)
def test_design_refuses_an_argument_by_its_python_name(arguments: dict[str, object]) -> None:
    """Not by the name of the command's option."""
    with pytest.raises(era.InputError) as error:
        era.design(make_paper_rig(12, 9), **arguments)  # type: ignore[arg-type]

    assert "--" not in str(error.value)


# Tables and queries


def test_table_has_the_drive_mode_that_a_daemon_chooses(tmp_path: Path) -> None:
    """Built by `era.table` or by `era table build`; two fingers get a vibration each."""
    path = tmp_path / "table.npz"
    build = ["table", "build", str(era.example_rig_path()), "-o", str(path), "--grid", "4x3"]
    *_, daemon_mode = playable_drive_modes(level_step=0.001, phase_step=0.01)

    table = era.table(RIG, frequencies=np.arange(60, 301, 20), grid=era.Grid(4, 3))
    completed = CliRunner().invoke(app, [*build, "--frequencies", "60:120:30"])

    assert completed.exit_code == 0, completed.output
    assert table.drive_mode == daemon_mode
    assert era.load_table(path).drive_mode == daemon_mode
    fingers = [era.Finger(TARGET, era.Stimulus()), era.Finger(QUIET, era.Stimulus())]
    assert len(era.answer(table, fingers).layers) == 2


@pytest.mark.parametrize("is_shaped", [False, True])
def test_query_equals_the_command(
    table: era.LocalizationTable, tmp_path: Path, is_shaped: bool
) -> None:
    """Every measure of `era table query --json`, from a table that was saved and loaded."""
    path = str(tmp_path / "table.npz")
    era.save_table(table, path)
    loaded = era.load_table(path)
    assert loaded.drive_mode == "phased"
    assert loaded.grid == era.Grid(4, 3)
    assert loaded.frequencies.tolist() == [60.0, 110.0, 250.0]

    quiet = [QUIET, OTHER_QUIET]
    answer = era.query(loaded, TARGET, quiet=quiet, level_db_sl=15, shaped=is_shaped)
    options = ["--target", "0.08,0.06", "--quiet", "0.22,0.16", "--quiet", "0.25,0.04"]
    options += ["--level", "15", "--json"]
    options += ["--envelopes"] if is_shaped else []
    completed = CliRunner().invoke(app, ["table", "query", path, *options])
    printed = json.loads(completed.stdout)

    for finger, felt in zip(printed["fingers"], answer.fingers, strict=True):
        assert finger["at_m"] == list(felt.finger.at)
        for key in ("verdict", "layer", "contrast_db", "promised_contrast_db", "lowered_db"):
            assert finger[key] == pytest.approx(getattr(felt, key), abs=1e-6), key
    measures = era.measures(loaded, answer)
    for key in ("transient_contrast_db", "residual_db", "is_imperceptible_to_quiet"):
        assert printed[key] == pytest.approx(getattr(measures, key), abs=1e-6), key
    (layer,) = answer.layers
    (printed_layer,) = printed["layers"]
    assert table.drive_of(layer.excitation) == printed_layer["drive"]
    assert bool(layer.onset) is is_shaped
    assert bool(printed_layer["onset"]) is is_shaped


@pytest.mark.parametrize("quiet", [QUIET, era.Finger(QUIET)], ids=["position", "finger"])
def test_query_is_the_answer_to_fingers_that_must_feel_one_vibration(
    table: era.LocalizationTable, quiet: era.Finger | tuple[float, float]
) -> None:
    """With a quiet finger, and for 40 ms."""
    stimulus = era.Stimulus(15.0, duration=0.04, name="any")
    targets = [TARGET, OTHER_QUIET]
    fingers = [era.Finger(target, stimulus, sharing="must") for target in targets]

    answer = era.answer(table, fingers, quiet=[quiet])

    same = era.query(table, targets, quiet=[QUIET], level_db_sl=15.0, duration=0.04)
    assert answer.layers == same.layers
    assert answer.layers[0].ramp == 0.01
    verdicts = [finger.verdict for finger in answer.fingers]
    assert verdicts[1:] == ["shared", "quiet"]


# Frames and pictures


def test_answer_frame_has_a_row_for_each_finger(table: era.LocalizationTable) -> None:
    """With the foreign levels of all threshold sets."""
    fingers = [era.Finger(TARGET, era.Stimulus()), era.Finger(QUIET, era.Stimulus())]
    answer = era.answer(table, fingers, drive_mode="phased")

    frame = answer.to_frame()

    felt = answer.fingers[1]
    row = frame.loc[1]
    assert [*frame["verdict"]] == [finger.verdict for finger in answer.fingers]
    assert row["x_m"] == QUIET[0]
    assert row["worst_foreign_level_db_sl"] == felt.foreign_level_db_sl
    assert row["rig_foreign_level_db_sl"] == felt.rig_foreign_level_db_sl


def test_plate_frames_have_a_row_for_each_mode_point_and_moment() -> None:
    """Of modes, of a map, and of a playback."""
    modes = PLATE.modes.to_frame()
    assert modes["frequency_hz"].tolist() == PLATE.modes.natural_frequencies.tolist()
    assert modes["damping_ratio"].between(0, 1).all()

    plate_field = PLATE.map({"SW": 110}, raster=(4, 3)).to_frame()
    assert plate_field.shape == (12, 3)
    assert plate_field["peak_m_s2"].min() > 0

    playback = PLATE.play({"SW": 110}, TARGET, quiet=[QUIET, OTHER_QUIET]).to_frame()
    assert playback["time_s"].iloc[-1] == pytest.approx(1.0, abs=0.001)
    assert [*playback.columns[1:]] == ["target_1_m_s2", "quiet_1_m_s2", "quiet_2_m_s2"]


def test_frames_need_pandas(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without it, the error says how to install it."""
    monkeypatch.setitem(sys.modules, "pandas", None)

    with pytest.raises(era.InputError, match=r"to_frame needs pandas.*pip install pandas"):
        PLATE.modes.to_frame()


def test_draw_answer_shows_fingers_and_levels(table: era.LocalizationTable) -> None:
    """Circles of 13 mm at the fingers, the promise in the title, levels in decibels."""
    answer = era.query(table, TARGET, quiet=[QUIET, OTHER_QUIET])
    felt = answer.fingers[0]

    axes = era.draw_answer(table, answer).axes[0]

    circles = [patch for patch in axes.patches if isinstance(patch, Circle)]
    centers = [circle.center for circle in circles]
    assert np.array(centers) == pytest.approx(np.array([[8, 6], [22, 16], [25, 4]]))
    assert {circle.radius for circle in circles} == {1.3}
    assert f"{felt.promised_contrast_db:.0f} dB" in axes.get_title()
    texts = [text.get_text() for text in axes.texts]
    assert texts.count("quiet") == 2
    assert f"felt\n{felt.level_db_sl:.0f} dB SL" in texts
    levels = np.asarray(axes.collections[0].get_array()).reshape(121, 121)
    row = round(0.06 / 0.2286 * 120)
    column = round(0.08 / 0.3048 * 120)
    assert levels[row, column] == pytest.approx(felt.level_db_sl, abs=1.0)


# Amplifiers


def test_commands_for_follows_the_wiring() -> None:
    """A wired channel whose ERA is silent has level 0; -1 rad is -57.296 degrees."""
    wiring = {
        "SW": Channel("a", 1),
        "SE": Channel("a", 0),
        "NE": Channel("b", 5),
        "NW": Channel("b", 2),
    }
    rig = replace(RIG, wiring=wiring, amplifiers={"a": "sim://", "b": "sim://"})
    drive = {"SW": era.Drive(110, level=0.25), "NE": era.Tone(90, 5e-5, -1)}

    commands = era.commands_for(rig, drive)

    tones = {}
    for name, layers in commands.items():
        for layer in layers:
            for tone in layer.tones:
                tones[name, tone.channel] = (tone.frequency, tone.level, tone.phase)
    assert tones == {
        ("a", 0): (40.0, 0.0, 0.0),
        ("a", 1): (110, 0.25, 0.0),
        ("b", 2): (40.0, 0.0, 0.0),
        ("b", 5): (90, pytest.approx(0.5), pytest.approx(-57.296, abs=1e-3)),
    }


def test_open_amplifier_simulates_a_rig_that_was_made_in_python() -> None:
    """Its default amplifier `sim://` needs no file, and has a channel for each ERA."""
    plate = era.Plate(length=0.3, width=0.2, thickness=0.0015, material="aluminium")
    eras = {}
    for name, position in {"SW": (0, 0), "SE": (0.3, 0), "NE": (0.3, 0.2)}.items():
        eras[name] = era.Era(at=position, stiffness="17 kN/m")

    with era.open_amplifier(era.rig(plate, eras)) as amplifier:
        assert amplifier.capabilities["channels"] == 3


def test_open_amplifier_applies_the_limits_of_the_rig() -> None:
    """It plays level 0.2, in steps of 1/10000, and refuses 0.21."""
    rig = replace(RIG, limits=replace(RIG.limits, level=0.2))
    (allowed,) = era.commands_for(rig, {"SW": era.Drive(110, level=0.2)}).values()
    (too_loud,) = era.commands_for(rig, {"SW": era.Drive(110, level=0.21)}).values()

    with era.open_amplifier(rig, url=f"sim://{era.example_rig_path()}") as amplifier:
        amplifier.arm()
        playing, *others = amplifier.play(allowed, duration=0.05).layers
        with pytest.raises(era.CommandRefused, match="level"):
            amplifier.apply(too_loud)

    levels = {command.channel: command.level for command in playing.commands}
    assert levels == {0: 2000, 1: 0, 2: 0, 3: 0}
    assert [layer.commands for layer in others] == [()] * len(others)


SPLIT = replace(RIG, amplifiers={"a": "sim://", "b": "sim://"})


@pytest.mark.parametrize("name", [None, "c"])
def test_open_amplifier_needs_a_name_when_a_rig_has_several(name: str | None) -> None:
    """The error lists their names."""
    with pytest.raises(era.InputError, match="a, b"):
        era.open_amplifier(SPLIT, name)


# Drives


def test_drive_may_be_a_frequency_a_share_or_a_tone() -> None:
    """A frequency alone is at full stroke, 100 um; a Drive has a share and degrees."""
    tone = era.Tone(250.0, 3e-5, 0.1)
    drive = {"SW": 110, "SE": era.Drive(110, level=0.25, phase_deg=-90), "NE": tone}

    (layer,) = playable_layers(drive, RIG)

    assert layer.excitation == {
        "SW": era.Tone(110, 1e-4, 0.0),
        "SE": era.Tone(110, 0.25e-4, -math.pi / 2),
        "NE": tone,
    }


TOO_LOUD = [era.Drive(110, 0.7), era.Drive(250, 0.6)]
REFUSED_DRIVES = {
    "unknown ERA": ({"XX": 110}, "XX'; choose from SW, SE, NE, NW"),
    "tone of an unknown ERA": (
        {"XX": era.Tone(110, 1e-4)},
        "XX'; choose from SW, SE, NE, NW",
    ),
    "0 Hz": ({"SW": 0}, "frequency.* got 0 Hz"),
    "text": ({"SW": "110 Hz"}, "frequency.* got '110 Hz'"),
    "negative frequency": ({"SW": [110, -1]}, "frequency.* got -1 Hz"),
    "low frequency": ({"SW": 39.9}, r"SW must be from 40 to 500 Hz, got 39.9 Hz; .*limits\.freq"),
    "tuple": ({"SW": (110, 0.5, 90)}, r"got \(110, 0.5, 90\); .*era\.Drive\(110, 0.5, 90\)"),
    "tone above full stroke": (
        {"SW": era.Tone(110, 1.00001e-4)},
        "level of SW.*0.0001 m, got 1.0000[01]",
    ),
    "not a number": ({"SW": era.Tone(110, math.nan)}, "level of SW.*got nan"),
    "sum above full stroke": ({"SE": 90, "SW": TOO_LOUD}, "level of SW.*got 1.29999"),
    "scaled layer": (Layer({"SW": era.Tone(110, 1e-4)}).scaled(1), "level of SW.*got 1.122"),
}


@pytest.mark.parametrize("case", REFUSED_DRIVES)
def test_drive_is_refused_with_its_era_and_value(case: str) -> None:
    """Unknown ERAs, frequencies, and more than the full stroke of an ERA."""
    drive, message = REFUSED_DRIVES[case]
    with pytest.raises(era.InputError, match=message):
        playable_layers(drive, RIG)


@pytest.mark.parametrize(
    ("level", "phase_deg", "message"),
    [(1.000000002, 0.0, "level.* got 1.000000002"), (1.0, math.inf, "phase.* got inf")],
)
def test_drive_refuses_a_level_or_phase(level: float, phase_deg: float, message: str) -> None:
    """A level above 1, and a phase that is not finite."""
    with pytest.raises(era.InputError, match=message):
        era.Drive(110, level=level, phase_deg=phase_deg)
