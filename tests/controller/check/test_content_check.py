"""What of content will be felt, beside the plate in time solved piece by piece."""

import json
import math
import wave
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from controller.content.pattern import Pattern, Transient
from era_haptics.lab.checks.content_check import check_content, kept_shares
from era_haptics.lab.checks.layout_check import loaded_plate
from era_haptics.lab.cli import app
from model.errors import InputError
from model.finger import (
    decibels,
    detection_threshold,
    fingertip_points,
    fingertip_weights,
    over_threshold,
)
from model.table.table import LocalizationTable
from model.table.table_file import build_table, save_table
from model.transients.base_motion import along_lines, raised_cosine
from model.transients.shaping import SAMPLE_RATE, Transients
from plates import smooth_rig

pytestmark = pytest.mark.usefixtures("plain_pictures")

AT, QUIET = (0.11, 0.13), (0.21, 0.06)
SWELL = Pattern(
    0.4, ((0.0, 0.4), (0.3, 1.0), (0.4, 0.0)), ((0.0, 0.5),), (Transient(0.15, 1.0, 0.2),)
)


@cache
def table() -> LocalizationTable:
    """Frequencies 20 Hz apart, which is quick to solve."""
    return build_table(smooth_rig(), frequencies=np.arange(60.0, 321.0, 20.0), drive_mode="phased")


def test_felt_level_is_that_of_the_plate_in_time() -> None:
    """A swell and a tap in it, also as terms of the bases, each between two knots by itself."""
    found = check_content(SWELL, table(), 20.0, at=AT)
    lasting, tap = found.parts
    bases = []
    for era in table().eras:
        swell, click = (each.answer.layers[0].excitation[era.name] for each in found.parts)
        ramp, omega = tap.answer.layers[0].ramp, 2 * math.pi * click.frequency
        course = lasting.stimulus.course
        assert course is not None
        end = click.phasor * np.exp(0.04j * omega)
        bases.append(
            (
                *along_lines(
                    0.0,
                    course.times[1],
                    2 * math.pi * swell.frequency,
                    [share * swell.phasor for share in course.shares],
                ),
                *raised_cosine(0.15, ramp, omega, 0, click.phasor),
                *raised_cosine(0.19, ramp, omega, 0, -end),
            )
        )
    transients = Transients(loaded_plate(table(), [AT]))
    points = fingertip_points(*AT, table().plate)
    moved = transients.acceleration(tuple(bases), points, duration=0.4)
    felt = over_threshold(moved, SAMPLE_RATE, table().threshold)
    for time in (0.06, 0.11, 0.17, 0.3):
        around = np.arange(-159, 160)
        window = np.cos(np.pi / 2 * around / 160) ** 2  # 20 ms wide at half its height
        some = felt[round(time * SAMPLE_RATE) + around]
        power = 2 * (window[:, None] * some**2).sum(axis=0) / window.sum()
        expected = decibels(np.sqrt(power) @ fingertip_weights(*AT, table().plate))
        assert found.given[round(time / found.step)] == pytest.approx(float(expected), abs=0.3)


def test_what_lasts_has_its_level_and_taps_theirs() -> None:
    """20 dB SL for a second, the plate's rise apart; then a tap of 15 dB SL alone."""
    pattern = Pattern(
        1.5, ((0.0, 1.0), (1.0, 1.0), (1.0, 0.0)), ((0.0, 0.5),), (Transient(1.3, 0.5, 0.5),)
    )
    found = check_content(pattern, table(), 20.0, at=AT)
    middle = found.given[round(0.2 / found.step) : round(0.9 / found.step)]
    assert np.median(middle) == pytest.approx(20.0, abs=1.0)
    assert found.given[round(1.3 / found.step) :].max() == pytest.approx(15.0, abs=2.0)
    assert found.kept_share > 0.9
    assert found.delay <= 0.01


def test_long_content_that_jumps_has_its_level() -> None:
    """Five seconds of 20 dB SL; by less than 2 dB more the plate overshoots after the jump."""
    pattern = Pattern(5.0, ((0.0, 0.0), (0.005, 1.0), (5.0, 1.0)))
    found = check_content(pattern, table(), 20.0, at=AT)
    assert np.median(found.given[: round(4.5 / found.step)]) == pytest.approx(20.0, abs=2.0)
    assert found.kept_share > 0.95


def test_kept_share_counts_levels_within_3_db_where_20_below_the_highest_are_asked() -> None:
    """Of 100 steps 40 count; 10 of these are 4 dB off; given 3 steps late."""
    expected = np.concatenate([np.full(30, 20.0), np.full(10, 5.0), np.full(60, -1.0)])
    given = np.roll(expected + np.where(np.arange(100) < 10, 4.0, 2.0), 3)
    assert kept_shares(expected, given, 5)[3] == pytest.approx(0.75)
    assert kept_shares(expected, given, 5).argmax() == 3


def test_taps_too_close_to_be_clicks_are_felt_in_what_lasts() -> None:
    """Of two equal taps 50 ms apart the second is in what lasts, from 30 ms after the first on."""
    taps = Transient(0.1, 1.0, 0.5), Transient(0.15, 1.0, 0.5)
    found = check_content(Pattern(0.3, transients=taps), table(), 20.0, at=AT)
    assert [each.stimulus.course is None for each in found.parts] == [False, True]
    assert found.kept_share > 0.9
    assert "1 of 2 taps" in found.lost[0]


def test_beside_a_quiet_finger_content_is_smoothed_and_promised() -> None:
    """The course starts and ends at rest; each part has a promise, the least counts."""
    found = check_content(SWELL, table(), 20.0, at=AT, quiet=[QUIET])
    course = found.parts[0].stimulus.course
    assert course is not None
    assert course.shares[0] == course.shares[-1] == 0
    promises = [each.answer.fingers[0].promised_contrast_db for each in found.parts]
    assert found.as_json()["promised_contrast_db"] == min(each for each in promises if each)


def test_command_says_what_is_kept_and_fails_below_the_least(tmp_path: Path) -> None:
    """Exit status 0 and 1 of the same content, its levels over time, and a picture."""
    save_table(table(), tmp_path / "table.npz")
    picture, place = tmp_path / "picture.png", "0.11,0.13"
    arguments = [
        "content",
        "check",
        "success",
        "--table",
        str(tmp_path / "table.npz"),
        "--at",
        place,
    ]
    result = CliRunner().invoke(app, [*arguments, "-o", str(picture), "--json"])
    assert result.exit_code == 0
    found = json.loads(result.stdout)
    assert found["kept_share"] >= 0.8
    assert found["level_db_sl"]["step_s"] == pytest.approx(0.005, abs=0.001)
    assert max(each for each in found["level_db_sl"]["given"] if each) > 15
    assert [each["time_s"] for each in found["parts"]] == sorted(
        each["time_s"] for each in found["parts"]
    )
    assert found["files"] == [str(picture)]
    assert picture.stat().st_size > 0
    result = CliRunner().invoke(app, [*arguments, "--least", "1", "--quiet", "0.21,0.06"])
    assert result.exit_code == 1
    assert "lost too much, at least 100 % must be" in result.stdout
    assert "dB above quiet fingers" in result.stdout


def test_command_tries_several_places_and_says_what_a_tap_loses(tmp_path: Path) -> None:
    """The median of five is shown, never the worst; of all its time all that is off its level."""
    save_table(table(), tmp_path / "table.npz")
    arguments = ["content", "check", "tick", "--table", str(tmp_path / "table.npz")]
    shares, sides = [], (table().plate.length, table().plate.width)
    for at in (None, (0.5, 0.5), (0.2, 0.3), (0.35, 0.75), (0.65, 0.2), (0.8, 0.6)):
        x, y = (each * side for each, side in zip(at or (0, 0), sides, strict=True))
        more = ["--at", f"{x},{y}"] if at else []
        found = json.loads(CliRunner().invoke(app, [*arguments, *more, "--json"]).stdout)
        off = sum(int(each.partition(" %")[0]) for each in found["lost"] if "wanted" in each)
        assert off / 100 == pytest.approx(1 - found["kept_share"], abs=0.06)
        shares.append(found["kept_share"])
    assert shares[0] == np.median(shares[1:])


def test_level_beyond_all_is_refused_as_it_was_given() -> None:
    """Not as what becomes of it in the file."""
    with pytest.raises(InputError, match="level must be between -100 and 60 dB SL, got 70;"):
        check_content(Pattern(0.3, ((0.0, 0.5), (0.3, 0.5))), table(), 70.0, at=AT)


def test_what_is_felt_is_written_as_sound(tmp_path: Path) -> None:
    """Intensity 1 for a second at 20 dB SL: ten times the threshold at its frequency, sampled.

    In 16 bits at 48 kHz, which Python's own module reads, of which full scale is as printed.
    """
    save_table(table(), tmp_path / "table.npz")
    envelope = {"amplitude": [{"time": 0, "amplitude": 1}, {"time": 1, "amplitude": 1}]}
    content = {"version": {"major": 1, "minor": 0, "patch": 0}, "metadata": {}}
    signals = {"signals": {"continuous": {"envelopes": envelope}}}
    (tmp_path / "even.haptic").write_text(json.dumps(content | signals))
    arguments = ["play", str(tmp_path / "even.haptic"), "--at", "0.11,0.13", "--json", "--simulate"]
    sound = tmp_path / "felt.wav"
    result = CliRunner().invoke(app, [*arguments, str(tmp_path / "table.npz"), "-o", str(sound)])
    assert result.exit_code == 0
    with wave.open(str(sound)) as file:
        assert (file.getsampwidth(), file.getnchannels(), file.getframerate()) == (2, 1, 48000)
        rate, samples = 48000, np.frombuffer(file.readframes(file.getnframes()), "<i2")
    assert np.abs(samples).max() == pytest.approx(0.9 * 32768, abs=1)
    middle = samples[int(0.3 * rate) : int(0.7 * rate)] / 32768
    middle *= json.loads(result.stdout)["full_scale_m_s2"]
    spectrum = np.abs(np.fft.rfft(middle))
    frequency = np.fft.rfftfreq(len(middle), 1 / rate)[spectrum.argmax()]
    threshold = float(detection_threshold(np.array(frequency), table().threshold))
    level = decibels(math.sqrt(2) * middle.std() / threshold)
    assert level == pytest.approx(20.0, abs=1.0)
