"""Pauses between retries."""

from registry.retries import Backoff


def test_backoff_resets_after_a_good_minute() -> None:
    """1, 2, 4, 5, 5 s, and 1 s again after a run of a minute."""
    backoff = Backoff(first=1.0, maximum=5.0)
    assert [backoff.pause(ran_for=59.9) for _ in range(5)] == [1, 2, 4, 5, 5]
    assert backoff.pause(ran_for=60.0) == 1
    assert backoff.pause(ran_for=0.0) == 2
