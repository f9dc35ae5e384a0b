"""A time limit for a run of pytest."""

import time

import pytest

MIN_TESTS = 50
"""Tests that always run, however slow the machine is."""


class TimeLimit:
    """A pytest plugin: end the run when its time [s] is up, but not before some tests have run.

    The time counts from the first test, or from a start (`time.monotonic`) before it. The run ends
    between two tests, so that a failure of the last one decides the exit status.
    """

    def __init__(
        self, seconds: float, *, start: float | None = None, min_tests: int = MIN_TESTS
    ) -> None:
        self.seconds = seconds
        self.min_tests = min_tests
        self.started_tests = 0
        self.start = start

    def pytest_runtest_logstart(self) -> None:
        """Count a test that is about to start, or end the run if the time is up."""
        now = time.monotonic()
        if self.start is None:
            self.start = now
        is_time_up = now >= self.start + self.seconds
        if is_time_up and self.started_tests >= self.min_tests:
            pytest.exit(f"{self.seconds:g} s are up: no failure so far", returncode=0)
        self.started_tests += 1
