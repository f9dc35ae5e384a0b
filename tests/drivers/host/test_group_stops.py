"""Stops of a group report what the amplifiers play, whatever happens to frames and on the way."""

import logging
import os
from collections.abc import Iterator

import pytest

from group_stops import LINES, PER_CHAIN, PROGRAMMES, Tally, play

STOPS, FIRST = (int(os.environ.get(name, value)) for name, value in (("STOPS", 216), ("FIRST", 0)))


@pytest.fixture(autouse=True)
def _unlogged() -> Iterator[None]:
    """Losses and planted exceptions are logged by the thousand."""
    logger = logging.getLogger("drivers")
    logger.setLevel(logging.CRITICAL)
    yield
    logger.setLevel(logging.NOTSET)


@pytest.mark.parametrize(
    ("programme", "share", "least"),
    [*zip(PROGRAMMES, (PER_CHAIN, 6, 6), (0.25, 0.25, 1 / 3), strict=True)],
)
@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # coroutines that were never awaited
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_stop_is_true(programme: str, share: int, least: float) -> None:
    """On every wire: what is confirmed silent is silent, and stays so.

    With faults of frames in every scene; with an exception at any line of the drivers that runs
    meanwhile; of an amplifier that a killed host has left playing.
    """
    tally = Tally()
    for seed in range(FIRST, FIRST + STOPS // share):
        play(programme, seed, tally)
    assert tally.found == []
    assert tally.total("confirmed") > tally.total("stops") * least
    if programme.startswith("frames"):
        assert all(tally.counts[wire, "may play"] for wire in LINES)
        assert tally.total("raised") == 0
