"""Checks of content: levels over time against the plate in time, and the command."""

import json
import math
import re
import shutil
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from controller.content.formats import named_content
from controller.content.pattern import Pattern, Transient
from era_haptics.lab.checks.content_check import check_content
from era_haptics.lab.checks.touch_simulator import loaded_plate
from era_haptics.lab.cli import app
from kit.plates import smooth_rig
from model.arrays import FloatArray
from model.errors import InputError
from model.finger import decibels, fingertip_points, fingertip_weights, over_threshold
from model.table.table import LocalizationTable
from model.table.table_file import build_table, save_table
from model.transients.base_motion import along_lines, raised_cosine
from model.transients.shaping import SAMPLE_RATE, Transients

pytestmark = pytest.mark.usefixtures("plain_pictures")

PLACE = (0.11, 0.13)
QUIET = (0.21, 0.06)


@cache
def table() -> LocalizationTable:
    """Return a table of frequencies 20 Hz apart, which is quick to solve."""
    return build_table(smooth_rig(), frequencies=np.arange(60.0, 321.0, 20.0), drive_mode="phased")


SWELL = Pattern(
    0.4, ((0.0, 0.4), (0.3, 1.0), (0.4, 0.0)), ((0.0, 0.5),), (Transient(0.15, 1.0, 0.2),)
)
"""A swell with a transient."""


def level_in_time(felt: FloatArray, time: float) -> float:
    """Return the level [dB SL] around a time [s], in a window 20 ms wide at half its height.

    felt: samples (n, points) of a fingertip, relative to the threshold.
    """
    offsets = np.arange(-159, 160)
    window = np.cos(np.pi / 2 * offsets / 160) ** 2
    samples = felt[round(time * SAMPLE_RATE) + offsets]
    powers = 2 * (window @ samples**2) / window.sum()
    weights = fingertip_weights(*PLACE, table().plate)
    return float(decibels(np.sqrt(powers) @ weights))


def test_felt_level_is_that_of_the_plate_in_time() -> None:
    """A swell and a transient, also as terms of the bases, each between two knots by itself."""
    check = check_content(SWELL, table(), 20.0, at=PLACE)

    swell, transient = check.parts
    course = swell.stimulus.course
    swell_tones = swell.answer.layers[0].excitation
    click = transient.answer.layers[0]
    bases = []
    for era in table().eras:
        swell_tone = swell_tones[era.name]
        click_tone = click.excitation[era.name]
        omega = 2 * math.pi * click_tone.frequency
        end = click_tone.phasor * np.exp(0.04j * omega)
        shares = [share * swell_tone.phasor for share in course.shares]
        swell_omega = 2 * math.pi * swell_tone.frequency
        terms = (
            *along_lines(0.0, course.times[1], swell_omega, shares),
            *raised_cosine(0.15, click.ramp, omega, 0, click_tone.phasor),
            *raised_cosine(0.19, click.ramp, omega, 0, -end),
        )
        bases.append(terms)
    plate = Transients(loaded_plate(table(), [PLACE]))
    points = fingertip_points(*PLACE, table().plate)
    acceleration = plate.acceleration(tuple(bases), points, duration=0.4)
    felt = over_threshold(acceleration, SAMPLE_RATE, table().threshold)
    for time in (0.06, 0.11, 0.17, 0.3):
        level = check.felt[round(time / check.step)]
        assert level == pytest.approx(level_in_time(felt, time), abs=0.3), time


def test_content_with_a_quiet_finger_is_smoothed_and_promised() -> None:
    """Its envelope starts and ends at rest; the lowest promise of its parts counts."""
    check = check_content(SWELL, table(), 20.0, at=PLACE, quiet=[QUIET])

    course = check.parts[0].stimulus.course
    assert course.shares[0] == course.shares[-1] == 0
    promises = []
    for part in check.parts:
        promised = part.answer.fingers[0].promised_contrast_db
        if promised:
            promises.append(promised)
    assert check.as_json()["promised_contrast_db"] == min(promises)


# The command


@pytest.fixture
def table_file(tmp_path: Path) -> str:
    """The file of the table."""
    path = tmp_path / "table.npz"
    save_table(table(), path)
    return str(path)


def run_check(content: str | Path, *options: str) -> Result:
    """Run `era content check`."""
    return CliRunner().invoke(app, ["content", "check", str(content), *options])


def report_of(content: str | Path, *options: str) -> dict[str, Any]:
    """Return the JSON object of `era content check`."""
    report: dict[str, Any] = json.loads(run_check(content, *options, "--json").stdout)
    return report


AT_PLACE = ("--at", "0.11,0.13")
CHARGING = Path(__file__).parents[4] / "examples" / "charging.haptic"


def test_command_reports_levels_over_time_and_draws_a_picture(
    tmp_path: Path, table_file: str
) -> None:
    """Its parts in the order of their times."""
    picture = tmp_path / "picture.png"

    report = report_of("success", "--table", table_file, *AT_PLACE, "-o", str(picture))

    assert report["kept_share"] >= 0.8
    levels = report["level_db_sl"]
    assert levels["step_s"] == pytest.approx(0.005, abs=0.001)
    assert max(filter(None, levels["given"])) > 15
    times = [part["time_s"] for part in report["parts"]]
    assert times == sorted(times)
    assert report["files"] == [str(picture)]
    assert picture.stat().st_size > 0


def test_command_fails_below_the_required_share(table_file: str) -> None:
    """Exit status 1."""
    quiet = ("--quiet", "0.21,0.06")

    result = run_check("success", "--table", table_file, *AT_PLACE, *quiet, "--least", "1")

    assert result.exit_code == 1
    assert "lost too much; at least 100 % of the level must be kept" in result.stdout
    assert "dB above quiet fingers" in result.stdout


FRACTIONS = ((0.5, 0.5), (0.2, 0.3), (0.35, 0.75), (0.65, 0.2), (0.8, 0.6))
"""The positions that are tried by default, relative to the plate's sides."""


def test_command_tries_five_positions_and_shows_the_median(table_file: str) -> None:
    """And lists the share that is off its level by its reasons."""
    plate = table().plate
    places = [("--at", f"{x * plate.length},{y * plate.width}") for x, y in FRACTIONS]
    shares = []
    for place in ((), *places):
        report = report_of("tick", "--table", table_file, *place)
        reasons = [reason for reason in report["lost"] if "wanted" in reason]
        percentages = [int(reason.partition(" %")[0]) for reason in reasons]
        lost = 1 - report["kept_share"]
        assert sum(percentages) / 100 == pytest.approx(lost, abs=0.06), place
        shares.append(report["kept_share"])

    output = run_check("tick", "--table", table_file).stdout

    default, *by_place = shares
    assert default == np.median(by_place)
    sentence = r"(\d) of 5 positions keep at least 80 %: (\d+) % at \S+, (\d+) % at "
    (numbers,) = re.findall(sentence, output)
    count = sum(share >= 0.8 for share in by_place)
    lowest, highest = math.floor(100 * min(by_place)), math.floor(100 * max(by_place))
    assert [int(number) for number in numbers] == [count, lowest, highest]


@pytest.fixture
def sweep(tmp_path: Path) -> Path:
    """A .haptic file with a sweep of 65 to 300 Hz in a second; the frequency is linear."""
    constant = [{"time": 0, "amplitude": 1}, {"time": 1, "amplitude": 1}]
    rising = []
    for time in np.linspace(0, 1, 101).tolist():
        rising.append({"time": time, "frequency": time**2})
    envelopes = {"amplitude": constant, "frequency": rising}
    content = {
        "version": {"major": 1, "minor": 0, "patch": 0},
        "metadata": {},
        "signals": {"continuous": {"envelopes": envelopes}},
    }
    path = tmp_path / "sweep.haptic"
    path.write_text(json.dumps(content))
    return path


def test_sweep_keeps_its_level_but_not_its_sharpness(sweep: Path) -> None:
    """It becomes one tone, on the built-in plate, without a table.

    Its best band, 245 to 300 Hz, is 23 % of the sweep.
    """
    report = report_of(sweep, *AT_PLACE)
    result = run_check(sweep, *AT_PLACE)

    assert report["table"] is None
    assert report["kept_share"] > 0.9
    sharpness = report["sharpness_kept_share"]
    assert sharpness == pytest.approx(0.23, abs=0.02)
    assert result.exit_code == 0
    assert result.stdout.startswith("plate: the founding paper's, 305 x 229 mm with 4 ERAs; ")
    percentage = math.floor(100 * sharpness)
    assert f"sharpness {percentage} % kept: level good" in result.stdout


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with a content in a subfolder, and another kind of file."""
    (tmp_path / "contents" / "taps").mkdir(parents=True)
    tick = tmp_path / "contents" / "taps" / "tick.ahap"
    tick.write_bytes(named_content("tick").read_bytes())
    (tmp_path / "contents" / "notes.txt").write_text("not a content")
    return tmp_path / "contents"


def test_unreadable_and_silent_files_fail_the_check_of_a_folder(
    folder: Path, table_file: str
) -> None:
    """The others are reported."""
    intensity = {"ParameterID": "HapticIntensity", "ParameterValue": 0}
    event = {"EventType": "HapticTransient", "Time": 0, "EventParameters": [intensity]}
    (folder / "broken.haptic").write_text("{}")
    (folder / "silent.ahap").write_text(json.dumps({"Pattern": [{"Event": event}]}))

    result = run_check(folder, "--table", table_file, *AT_PLACE, "--least", "0.1", "--json")

    assert result.exit_code == 1
    broken, silent, tick = json.loads(result.stdout)["contents"]
    assert broken["error"].startswith(str(folder / "broken.haptic"))
    assert silent["error"] == f"{folder / 'silent.ahap'}: must not be silent"
    assert tick["file"] == str(folder / "taps" / "tick.ahap")
    assert tick["kept_share"] >= 0.1


def test_comparison_is_at_one_position_and_on_one_scale(tmp_path: Path, table_file: str) -> None:
    """Each file as `check` finds it there; a folder counts as its files."""
    (tmp_path / "folder").mkdir()
    shutil.copy(CHARGING, tmp_path / "folder" / "own.haptic")
    picture = tmp_path / "compared.png"
    command = ["content", "compare", "success", str(tmp_path / "folder"), "--table", table_file]

    result = CliRunner().invoke(app, [*command, *AT_PLACE, "-o", str(picture), "--json"])

    report = json.loads(result.stdout)
    assert report["files"] == [str(picture)]
    assert picture.stat().st_size > 0
    contents = report["contents"]
    names = [content["file"] for content in contents]
    assert names == ["success", str(tmp_path / "folder" / "own.haptic")]
    for content, source in zip(contents, ("success", CHARGING), strict=True):
        alone = report_of(source, "--table", table_file, *AT_PLACE)
        assert content["at_m"] == [0.11, 0.13]
        assert content["kept_share"] == alone["kept_share"]
        assert content["level_db_sl"] == alone["level_db_sl"]

    rows = CliRunner().invoke(app, command).stdout.splitlines()
    shares = [row.split()[1] for row in rows[1:3]]
    assert len(shares) == 2
    assert rows[-1].startswith("at ")
    many = CliRunner().invoke(app, [*command[:2], *["tick"] * 9, "-o", str(picture)])
    assert isinstance(many.exception, InputError)
