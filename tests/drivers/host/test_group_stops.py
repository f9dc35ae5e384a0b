"""Stops of a group report what the amplifiers play, whatever happens to frames and on the way."""

import logging
from collections.abc import Iterator

import pytest

from group_stops import (
    LINES,
    Tally,
    disturbed_stops,
    stop_of_killed_host,
    stop_with_exception,
)


@pytest.fixture(autouse=True)
def _unlogged() -> Iterator[None]:
    """Losses and planted exceptions are logged by the thousand."""
    logger = logging.getLogger("drivers")
    logger.setLevel(logging.CRITICAL)
    yield
    logger.setLevel(logging.NOTSET)


def test_stop_is_true_while_frames_are_lost_late_and_doubled() -> None:
    """On every wire and in every scene: what is confirmed silent is silent, and stays so."""
    tally = Tally()
    for seed in range(3 * len(LINES)):
        disturbed_stops(seed, tally)
    assert tally.found == []
    for wire in LINES:
        assert tally.counts[wire, "confirmed"] > tally.counts[wire, "stops"] / 4
        assert tally.counts[wire, "may play"] > 0
    assert tally.total("raised") == 0


@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # coroutines that were never awaited
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_stop_is_true_with_an_exception_on_its_way() -> None:
    """Raised at any line of the drivers that runs while all is being stopped."""
    tally = Tally()
    for seed in range(6 * len(LINES)):
        stop_with_exception(seed, tally)
    assert tally.found == []
    assert tally.total("confirmed") > tally.total("stops") / 4


def test_amp_stop_is_true_after_a_killed_host() -> None:
    """`era amp stop` with a faulty wire, for an amplifier that a killed host has left playing."""
    tally = Tally()
    for seed in range(6 * len(LINES)):
        stop_of_killed_host(seed, tally)
    assert tally.found == []
    assert tally.total("confirmed") > tally.total("stops") / 3
