"""Pauses between attempts."""

from itertools import islice

import pytest

from drivers.pauses import Backoff, pauses


def test_pauses_grow_up_to_a_limit() -> None:
    """Each twice the one before: 0.1, 0.2, ... 5 s."""
    assert list(islice(pauses(), 8)) == pytest.approx([0.1, 0.2, 0.4, 0.8, 1.6, 3.2, 5.0, 5.0])


def test_backoff_resets_after_a_good_minute() -> None:
    """1, 2, 4, 5, 5 s, and 1 s again after what ran for a minute."""
    backoff = Backoff(first=1.0, maximum=5.0)
    assert [backoff.pause(ran_for=59.9) for _ in range(5)] == [1, 2, 4, 5, 5]
    assert [backoff.pause(ran_for=each) for each in (60.0, 0.0)] == [1, 2]
