"""A time limit for a run of pytest that counts from the first test."""

import time

import pytest

MIN_TESTS = 50
"""Tests that always run, however slow the machine is."""


class TimeLimit:
    """A pytest plugin: end the run some seconds after the first test, but not before MIN_TESTS.

    It ends between two tests, so that a failure of the last one decides the exit status.
    """

    def __init__(self, seconds: float) -> None:
        self.seconds = seconds
        self.started_tests = 0
        self.ends_at = 0.0

    def pytest_runtest_logstart(self) -> None:
        """Count a test that is about to start, or end the run if the time is up."""
        now = time.monotonic()
        if self.started_tests == 0:
            self.ends_at = now + self.seconds
        if self.started_tests >= MIN_TESTS and now >= self.ends_at:
            pytest.exit(f"{self.seconds:g} s after the first test: no failure so far", returncode=0)
        self.started_tests += 1
