"""Sessions that measure the latency of touches: what they count is the answer to each touch."""

import sys

import pytest

from benchmarks.latency.session import daemon_session, taps

COUNT, PLANTED = 10, 0.08  # s


@pytest.mark.long
@pytest.mark.alone
@pytest.mark.parametrize("is_two", [False, True])
async def test_time_of_every_touch_holds_a_delay_of_the_daemon(is_two: bool) -> None:
    """Each set that is counted answers its own touch; with two contents, the later of both.

    The daemon takes a time longer for every frame of the panel.
    """
    program = (sys.executable, "-m", "benchmarks.latency.planted", PLANTED)
    async with daemon_session("paper_plate", program=program, is_two=is_two) as session:
        measured = await taps(session, COUNT, is_two=is_two)
    assert measured.unanswered == 0
    assert measured.times.min() > PLANTED
    assert measured.times.min() > measured.wire > 0
