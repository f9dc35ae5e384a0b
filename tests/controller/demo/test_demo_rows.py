"""Rows, measures and the choice of touches of the demonstration, without running it."""

from dataclasses import replace

import numpy as np
import pytest

from controller.demo.pictures import choose_rows
from controller.demo.touch_row import (
    FingerRow,
    FingerVibration,
    TouchRow,
    felt_contrast_db,
    peak_contrast_db,
    steady_contrast_db,
)
from model.finger.perception import detection_threshold

FIGURES = ("felt_contrast_db", "contrast_db", "transient_contrast_db", "level_db_sl")
ROBUST = ("robust_felt_contrast_db", "robust_contrast_db")
KEYS = (
    *("time_s", "until_s", "targets_m", "quiet_m", "reason", "drive", "mode", "latency_ms"),
    *("played_s", "shaped_onset", "steady"),
)
FINGER = FingerRow(
    at_m=(0.1, 0.1),
    frequency_hz=90.0,
    verdict="own",
    promised_contrast_db=12.0,
    measured_contrast_db=14.0,
    measured_level_db_sl=20.0,
)
FINGER_KEYS = {
    *("at_m", "frequency_hz", "verdict"),
    *("promised_contrast_db", "measured_contrast_db", "measured_level_db_sl"),
}


def vibration(amplitudes, frequencies=(100.0, 250.0)):
    """A finger with amplitudes (f, p) at its points."""
    amplitudes = np.array(amplitudes, dtype=float).reshape(len(frequencies), -1)
    count = amplitudes.shape[1]
    weights = np.full(count, 1 / count)
    return FingerVibration(np.array(frequencies), amplitudes, amplitudes.sum(axis=0), weights)


def row(time, *, contrast, others):
    """A measured touch with other fingers on the plate."""
    return TouchRow(
        target_id="t",
        time_s=time,
        until_s=time + 1,
        targets_m=[(0.05, 0.05), (0.2, 0.1)],
        quiet={f"q{n}": (0.1, 0.01 * n) for n in range(others)},
        measured_level_db_sl=19.0,
        measured_felt_contrast_db=contrast,
    )


def test_steady_contrast_relates_mean_of_target_to_loudest_quiet_point():
    """By hand: mean of (3 + 1, 5 + 1) is 5, the loudest quiet point 0.5, so 20 dB."""
    target = vibration([[3.0, 5.0], [1.0, 1.0]])
    quiet = [vibration([[0.1, 0.4], [0.1, 0.1]]), vibration([[0.2], [0.2]])]
    assert steady_contrast_db(target, quiet) == pytest.approx(20.0)
    assert steady_contrast_db(target, []) is None


def test_felt_contrast_relates_levels_not_accelerations():
    """Ten times threshold at 100 Hz against the same acceleration at 250 Hz: their thresholds'.

    Both tones together are felt as the square root of the sum of squares.
    """
    low, high = detection_threshold(np.array([100.0, 250.0]))
    target, quiet = vibration([[10 * low], [0.0]]), vibration([[0.0], [10 * low]])
    assert felt_contrast_db(target, [quiet]) == pytest.approx(20 * np.log10(high / low))
    assert felt_contrast_db(target, []) is None
    both = vibration([[3 * low, 0.0], [4 * high, 0.0]])
    assert felt_contrast_db(target, [both, quiet]) == pytest.approx(
        20 - 20 * np.log10(max(5, 10 * low / high))
    )


def test_contents_are_told_apart_by_their_frequencies():
    """By hand: 10 times threshold of its own, 0.3 and 0.4 of others: 26 dB above their power."""
    thresholds = detection_threshold(np.array([90.0, 170.0, 260.0]))
    felt = vibration(np.diag(thresholds) @ [[10.0], [0.3], [0.4]], (90.0, 170.02, 260.0))
    own, foreign = felt.parted(90.0)
    assert own.level_db_sl == pytest.approx(20.0)
    assert felt_contrast_db(own, [foreign]) == pytest.approx(20 + 6.02, abs=0.01)
    nothing, all_others = felt.parted(500.0)
    assert nothing.level_db_sl == -np.inf
    assert all_others.level_db_sl == pytest.approx(felt.level_db_sl)


def test_promise_is_kept_by_at_least_the_robust_contrast():
    """Only steady touches with a promise and a measurement count."""
    promised = replace(row(1.0, contrast=12.0, others=1), steady=True, robust_felt_contrast_db=12.0)
    assert promised.keeps_promise
    assert replace(promised, measured_felt_contrast_db=11.9).keeps_promise is False
    for unknown in (
        {"steady": False},
        {"robust_felt_contrast_db": None},
        {"measured_felt_contrast_db": None},
    ):
        assert replace(promised, **unknown).keeps_promise is None


def test_peak_contrast_by_hand():
    """Mean peak of the target's points is 6, the loudest quiet peak 0.6, so 20 dB."""
    target = vibration([[3.0, 5.0], [1.0, 3.0]])
    quiet = [vibration([[0.1, 0.4], [0.1, 0.2]]), vibration([[0.2], [0.1]])]
    assert peak_contrast_db(target, quiet) == pytest.approx(20.0)


def test_json_has_the_documented_keys_of_every_touch():
    """Also of one that was not driven: without figures, but with the reason."""
    silent = replace(row(1.0, contrast=None, others=1), reason="too close")
    figures = {f"{what}_{of}" for what in ("predicted", "measured") for of in FIGURES}
    assert silent.as_json().keys() == {*figures, *ROBUST, *KEYS}
    assert silent.as_json()["quiet_m"] == [(0.1, 0.0)]
    shared = replace(silent, fingers=[FINGER])
    assert shared.as_json().keys() - silent.as_json().keys() == {"fingers"}
    (finger,) = shared.as_json()["fingers"]
    assert finger.keys() == FINGER_KEYS


def test_picture_shows_highest_contrasts_of_each_number_of_fingers():
    """Six panels, fewest fingers first; a touch without measurement is left out."""
    rows = [row(n, contrast=float(n), others=1 + n % 2) for n in range(10)]
    silent = replace(row(99.0, contrast=99.0, others=1), measured_level_db_sl=None)
    chosen = choose_rows([*rows, silent])
    assert [len(each.quiet) for each in chosen] == [1, 1, 1, 2, 2, 2]
    assert {each.time_s for each in chosen} == {8, 6, 4, 9, 7, 5}
