"""Exposure of fingers, weighted as for the hand."""

import numpy as np
import pytest

from model.answer.answer_report import exposures, hand_weighting
from model.answer.stimulus import Finger
from model.finger import detection_threshold
from plates import smooth_table
from set_table import phased as answer
from set_table import wants

PUBLISHED = {
    6.3: 0.727, 8: 0.873, 10: 0.951, 12.5: 0.958, 16: 0.896, 20: 0.782, 25: 0.647, 31.5: 0.519,
    40: 0.411, 50: 0.324, 63: 0.256, 80: 0.202, 100: 0.160, 125: 0.127, 160: 0.101, 200: 0.0799,
    250: 0.0634, 315: 0.0503, 400: 0.0398, 500: 0.0314, 630: 0.0245, 800: 0.0186, 1000: 0.0135,
    1250: 0.00894,
}  # fmt: skip
"""Factors of ISO 5349-1:2001, table A.2, at the nominal frequencies of third octaves [Hz]."""


def test_weighting_is_that_of_the_standard():
    """Its table is of the exact frequencies, 10^(n/10)."""
    nominal = np.array([*PUBLISHED])
    exact = 10 ** (np.round(10 * np.log10(nominal)) / 10)
    assert hand_weighting(exact) == pytest.approx([*PUBLISHED.values()], rel=5e-3)


def test_exposure_is_the_weighted_root_mean_square_of_all_that_a_finger_feels():
    """By levels above threshold: of a content alone, of what leaks, and of two together.

    A finger's own content counts at its loudest point, up to 6 dB above the mean of its level.
    """
    table = smooth_table()
    found = answer(table, [wants((0.09, 0.07)), wants((0.25, 0.18))], [Finger((0.16, 0.20))])
    weighted = []
    for layer in found.layers:
        f = np.array([layer.frequency])
        weighted.append(float(hand_weighting(f)[0] * detection_threshold(f)[0] / np.sqrt(2)))
    first, second, quiet = exposures(table, found)
    for exposure, each, own in zip((first, second), found.fingers, weighted, strict=False):
        mean = own * 10 ** (each.promised_level_db_sl / 20)
        assert mean < exposure < 2.5 * mean
    heard = 10 ** (found.fingers[2].foreign_level_db_sl / 20)
    assert min(weighted) * heard <= quiet <= max(weighted) * heard
    louder = answer(
        table,
        [wants((0.09, 0.07), level_db_sl=26.0), wants((0.25, 0.18), level_db_sl=26.0)],
        [Finger((0.16, 0.20))],
    )
    assert exposures(table, louder) == pytest.approx(
        [10 ** (6 / 20) * each for each in (first, second, quiet)], rel=1e-3
    )
