"""Rows, measures and the choice of touches of the demonstration, without running it."""

from dataclasses import replace

import numpy as np
import pytest

from controller.demo.picture import choose_rows
from controller.demo.touch_row import (
    FingerVibration,
    PlayedPattern,
    TouchRow,
    peak_contrast_db,
    steady_contrast_db,
)
from model.finger.perception import detection_threshold
from model.table.pattern import Pattern


def vibration(amplitudes, frequencies=(100.0, 250.0)):
    """A finger with amplitudes (f, p) at its points."""
    amplitudes = np.array(amplitudes, dtype=float).reshape(len(frequencies), -1)
    return FingerVibration(np.array(frequencies), amplitudes, amplitudes.sum(axis=0))


def row(time, *, contrast, others):
    """A measured touch with other fingers on the plate."""
    quiet = {f"q{n}": (0.1, 0.01 * n) for n in range(others)}
    played = PlayedPattern(
        pattern=Pattern({}, 0.02, 20.0, contrast, 0.0),
        drive={},
        latency=0.004,
        duration=0.5,
        is_onset_shaped=True,
        predicted_level_db_sl=20.0,
        measured_level_db_sl=19.0,
        predicted_contrast_db=contrast,
        measured_contrast_db=contrast,
        predicted_transient_contrast_db=10.0,
        measured_transient_contrast_db=11.0,
        levels_db_sl={},
    )
    return TouchRow("t", time, time + 1, (0.05, 0.05), (), quiet, played, None)


def test_steady_contrast_relates_mean_of_target_to_loudest_quiet_point():
    """By hand: mean of (3 + 1, 5 + 1) is 5, the loudest quiet point 0.5, so 20 dB."""
    target = vibration([[3.0, 5.0], [1.0, 1.0]])
    quiet = [vibration([[0.1, 0.4], [0.1, 0.1]]), vibration([[0.2], [0.2]])]
    assert steady_contrast_db(target, quiet) == pytest.approx(20.0)
    assert steady_contrast_db(target, []) is None


def test_peak_contrast_by_hand():
    """Mean peak of the target's points is 6, the loudest quiet peak 0.6, so 20 dB."""
    target = vibration([[3.0, 5.0], [1.0, 3.0]])
    quiet = [vibration([[0.1, 0.4], [0.1, 0.2]]), vibration([[0.2], [0.1]])]
    assert peak_contrast_db(target, quiet) == pytest.approx(20.0)


def test_level_of_tone_ten_times_above_threshold_is_20_db():
    """A tone of ten times the detection threshold has 20 dB SL; no tone has minus infinity."""
    threshold = detection_threshold(np.array([100.0, 250.0]))
    assert vibration([[10 * threshold[0]], [0.0]]).level_db_sl == pytest.approx(20.0)
    nothing = FingerVibration(np.zeros(0), np.zeros((0, 3)), np.zeros(3))
    assert nothing.level_db_sl == -np.inf


def test_json_lists_all_targets_and_the_onset():
    """The touch itself comes first, then further targets; contrast steady and over 100 ms."""
    printed = replace(row(1.0, contrast=12.0, others=1), other_targets=((0.2, 0.1),)).as_json()
    assert printed["targets_m"] == [[0.05, 0.05], [0.2, 0.1]]
    assert printed["shaped_onset"]
    assert (printed["mode"], printed["predicted_contrast_db"]) == ("switched", 12.0)
    assert printed["predicted_transient_contrast_db"] == 10.0
    assert printed["measured_transient_contrast_db"] == 11.0
    assert printed["predicted_level_db_sl"] == 20.0


def test_json_of_silent_touch_has_same_keys_and_reason():
    """A touch that was not driven has the keys of one that was, no figures, and a reason."""
    silent = TouchRow("t", 1.0, 1.5, (0.1, 0.2), (), {"q": (0.2, 0.2)}, None, "too close")
    printed = silent.as_json()
    assert printed.keys() == row(1.0, contrast=1.0, others=1).as_json().keys()
    assert printed["drive"] == {}
    assert printed["reason"] == "too close"
    assert printed["measured_contrast_db"] is None
    assert printed["quiet_m"] == [[0.2, 0.2]]


def test_picture_shows_highest_contrasts_of_each_number_of_fingers():
    """Six panels, fewest fingers first; a touch without measurement is left out."""
    rows = [row(n, contrast=float(n), others=1 + n % 2) for n in range(10)]
    silent = TouchRow("t", 99.0, 99.5, (0.1, 0.1), (), {}, None, "too close")
    chosen = choose_rows([*rows, silent])
    assert [len(each.quiet) for each in chosen] == [1, 1, 1, 2, 2, 2]
    assert {each.time for each in chosen} == {8, 6, 4, 9, 7, 5}
