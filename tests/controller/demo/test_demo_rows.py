"""Measures and rows of the demonstration, without running it."""

from dataclasses import replace

import numpy as np
import pytest

from controller.demo.far_end import FingerFelt
from controller.demo.measure import finger_level, measure, peak_contrast_db
from controller.demo.picture import choose_rows
from controller.demo.rows import Onset, PlayedPattern, TouchRow
from model.finger.perception import detection_threshold
from model.table.pattern import Pattern


def felt(amplitudes, frequencies=(100.0, 250.0)):
    """A finger with these amplitudes (f, p) at each of its points."""
    amplitudes = np.array(amplitudes, dtype=float).reshape(len(frequencies), -1)
    return FingerFelt(np.array(frequencies), amplitudes, amplitudes.sum(axis=0))


def row(time, *, contrast, others):
    """A touch with a measured contrast, among other fingers."""
    quiet = {f"q{n}": (0.1, 0.01 * n) for n in range(others)}
    measured = measure(felt([[10 ** (contrast / 20)], [0.0]]), [felt([[1.0], [0.0]])])
    pattern = Pattern({}, 0.02, 20.0, contrast, 0.0)
    onset = Onset(True, 10.0, 11.0)
    played = PlayedPattern(pattern, 20.0, contrast, onset, {}, 0.004, 0.5, measured, {})
    return TouchRow("t", time, time + 1, (0.05, 0.05), (), quiet, played, None)


def test_contrast_is_the_targets_mean_to_the_loudest_quiet_point():
    """By hand: mean of (3 + 1, 5 + 1) is 5, the loudest quiet point 0.5, so 20 dB."""
    target = felt([[3.0, 5.0], [1.0, 1.0]])
    quiet = [felt([[0.1, 0.4], [0.1, 0.1]]), felt([[0.2], [0.2]])]
    assert measure(target, quiet).contrast_db == pytest.approx(20.0)


def test_contrast_of_peaks_by_hand():
    """Mean peak of the target's points 6, the loudest quiet peak 0.6, each 20 dB apart."""
    target = felt([[3.0, 5.0], [1.0, 3.0]])
    quiet = [felt([[0.1, 0.4], [0.1, 0.2]]), felt([[0.2], [0.1]])]
    assert peak_contrast_db(target, quiet) == pytest.approx(20.0)


def test_every_target_and_the_onset_stand_in_json():
    """The touch itself first, then those that feel it with it; contrast steady and over 100 ms."""
    printed = replace(row(1.0, contrast=12.0, others=1), together=((0.2, 0.1),)).as_json()
    assert printed["targets_m"] == [[0.05, 0.05], [0.2, 0.1]]
    assert printed["shaped_onset"]
    assert (printed["mode"], printed["predicted_contrast_db"]) == ("switched", 12.0)
    assert printed["predicted_transient_contrast_db"] == 10.0
    assert printed["measured_transient_contrast_db"] == 11.0
    assert printed["predicted_level_db_sl"] == 20.0


def test_a_lone_finger_has_a_level_only():
    """A tone ten times above threshold is 20 dB SL; there is no contrast to speak of."""
    threshold = detection_threshold(np.array([100.0, 250.0]))
    measured = measure(felt([[10 * threshold[0]], [0.0]]), [])
    assert measured.level_db_sl == pytest.approx(20.0)
    assert measured.contrast_db is None


def test_nothing_played_is_nothing_measured():
    """Without any driven frequency in the window there is no measure, and the level is -inf."""
    nothing = FingerFelt(np.zeros(0), np.zeros((0, 3)), np.zeros(3))
    assert measure(nothing, []) is None
    assert finger_level(nothing) == -np.inf


def test_the_picture_takes_the_clearest_touches_of_each_number_of_fingers():
    """Six panels, fewest fingers first; a touch that was not measured is left out."""
    rows = [row(n, contrast=float(n), others=1 + n % 2) for n in range(10)]
    silent = TouchRow("t", 99.0, 99.5, (0.1, 0.1), (), {}, None, "too close")
    chosen = choose_rows([*rows, silent])
    assert [len(r.quiet) for r in chosen] == [1, 1, 1, 2, 2, 2]
    assert {r.time for r in chosen} == {8, 6, 4, 9, 7, 5}


def test_a_silent_touch_says_why_in_json():
    """No drive, no figures, a reason."""
    silent = TouchRow("t", 1.0, 1.5, (0.1, 0.2), (), {"q": (0.2, 0.2)}, None, "too close")
    printed = silent.as_json()
    assert printed["drive"] == {}
    assert printed["reason"] == "too close"
    assert printed["measured_contrast_db"] is None
    assert printed["quiet_m"] == [[0.2, 0.2]]
