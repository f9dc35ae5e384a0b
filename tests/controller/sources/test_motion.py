"""How fast a finger moves, by places whose errors are those of a panel."""

import numpy as np
import pytest

from controller.sources.touch import OVER, Motion

FRAME = 0.010  # s


def moved(places: np.ndarray) -> Motion:
    """A finger reported every 10 ms at these places (n, 2) [m]; the last at time 0."""
    motion, count = Motion(), len(places)
    for number, (x, y) in enumerate(places.tolist(), start=1):
        motion = motion.followed((number - count) * FRAME, x, y)
    return motion


def test_velocity_is_that_of_a_steady_way() -> None:
    """0.2 m/s to the right and 0.1 down, exactly, whatever its course before the last 60 ms."""
    times = np.arange(12) * FRAME
    places = np.column_stack([0.05 + 0.2 * times, 0.1 - 0.1 * times])
    places[:4] = 0.3
    assert moved(places).velocity(0.0) == pytest.approx((0.2, -0.1))


def test_jitter_of_a_resting_finger_is_no_motion() -> None:
    """Errors of 0.3 mm rms in 200 courses, and a single place: zero, not nearly."""
    rng = np.random.default_rng(1)
    for _ in range(200):
        assert moved(0.1 + rng.normal(0, 0.3e-3, (10, 2))).velocity(0.0) == (0.0, 0.0)
    assert moved(np.array([[0.1, 0.1]])).velocity(0.0) == (0.0, 0.0)


def test_jitter_changes_a_velocity_by_a_sixth_at_most_mostly() -> None:
    """Errors of 1 mm at 0.2 m/s: the slope's deviation is 1 mm / sqrt(sum of squared times)."""
    rng, times = np.random.default_rng(2), np.arange(10) * FRAME
    found = []
    for _ in range(300):
        places = np.column_stack([0.2 * times, 0 * times]) + rng.normal(0, 1e-3, (10, 2))
        found.append(moved(places).velocity(0.0)[0])
    used = FRAME * np.arange(6)
    assert np.std(found) == pytest.approx(
        1e-3 / np.sqrt(((used - used.mean()) ** 2).sum()), rel=0.2
    )
    assert np.mean(found) == pytest.approx(0.2, abs=0.01)


def test_a_finger_that_is_reported_no_more_rests() -> None:
    """A source that reports changes alone says nothing of one that stops: 60 ms later it rests."""
    times = np.arange(8) * FRAME
    motion = moved(np.column_stack([0.2 * times, 0 * times]))
    assert motion.velocity(0.02)[0] == pytest.approx(0.2)
    assert motion.velocity(OVER) == (0.0, 0.0)
