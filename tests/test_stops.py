"""Stops report what the amplifiers play, whatever happens to frames and on the way."""

import logging
from collections.abc import Iterator

import pytest

from stop_chain import WIRES
from stops import Tally, disturbed_stops, stops_by_command, stops_with_exceptions


@pytest.fixture(autouse=True)
def _unlogged() -> Iterator[None]:
    """Losses and planted exceptions are logged by the thousand."""
    loggers = [logging.getLogger(name) for name in ("controller", "drivers")]
    for logger in loggers:
        logger.setLevel(logging.CRITICAL)
    yield
    for logger in loggers:
        logger.setLevel(logging.NOTSET)


def test_stop_is_true_while_frames_are_lost_late_and_doubled() -> None:
    """On every wire and in every scene: what is confirmed silent is silent, and stays so."""
    tally = Tally()
    disturbed_stops(range(3 * len(WIRES)), tally=tally)
    assert tally.found == []
    for wire in WIRES:
        assert tally.counts[wire, "confirmed_silent"] > tally.counts[wire, "stops"] / 4
        assert tally.counts[wire, "watchdog_elapsed"] + tally.counts[wire, "may_play"] > 0
    assert tally.total("raised") == 0


@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # coroutines that were never awaited
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_stop_is_true_with_an_exception_on_its_way() -> None:
    """Raised at any line of drivers or controller that runs while all is being stopped."""
    tally = Tally()
    stops_with_exceptions(range(3 * len(WIRES)), tally=tally)
    assert tally.found == []
    assert tally.total("confirmed_silent") > tally.total("stops") / 4


def test_amp_stop_is_true_after_a_killed_host() -> None:
    """`era amp stop` with a faulty wire, for amplifiers that a killed host has left playing."""
    tally = Tally()
    stops_by_command(range(2 * len(WIRES)), tally=tally)
    assert tally.found == []
    assert tally.total("confirmed_silent") > tally.total("stops") / 3
