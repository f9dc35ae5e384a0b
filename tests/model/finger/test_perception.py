"""Detection thresholds and levels above them."""

import numpy as np
import pytest

from model.finger.perception import detection_threshold, sensation_level


def test_detection_threshold_equals_table():
    """At 250 Hz a fingertip detects 0.1 um, 0.247 m/s² (Verrillo 1963 and followers)."""
    displacement = detection_threshold(np.array([250.0])) / (2 * np.pi * 250.0) ** 2
    assert displacement[0] == pytest.approx(0.100e-6, rel=0.01)


def test_sensation_level_of_one_g_at_250_hz_is_32_db():
    """9.8 m/s² against 0.247 m/s² is 20 log10 39.7 = 32.0 dB."""
    level = sensation_level(np.array([250.0]), np.array([9.8]))
    assert level == pytest.approx(32.0, abs=0.05)


def test_sensation_level_adds_tones_as_powers():
    """Two tones each at threshold are together 3 dB above it."""
    frequencies = np.array([100.0, 250.0])
    level = sensation_level(frequencies, detection_threshold(frequencies))
    assert level == pytest.approx(10 * np.log10(2))


def test_sensation_level_of_zero_is_minus_infinity():
    """Where nothing moves the level is minus infinity, not an error."""
    assert sensation_level(np.array([100.0]), np.array([0.0])) == -np.inf
