"""Counting bad input."""

import logging

import pytest

from controller.sources.reject_counter import RejectCounter


def test_reject_counter_logs_once_per_interval(caplog: pytest.LogCaptureFixture) -> None:
    """A thousand bad datagrams within a second are all counted and make one line, as do later."""
    now = 0.0
    rejects = RejectCounter(logging.getLogger("bad input"), clock=lambda: now)
    for _ in range(1000):
        rejects.count("malformed", "ends too early")
    assert rejects.counts == {"malformed": 1000}
    assert len(caplog.records) == 1
    now = 1.0
    rejects.count("late", "frame 3")
    assert len(caplog.records) == 2
    assert "new=1000" in caplog.records[1].getMessage()
    assert "late 1, malformed 1000" in caplog.records[1].getMessage()
