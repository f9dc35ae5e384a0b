"""The benchmark of touch to wire: a real daemon on its lines, tapped in random places."""

import sys

import pytest

from benchmarks.latency.session import Taps, daemon_session, plain_session, taps

pytestmark = [pytest.mark.long, pytest.mark.alone]

COUNT, PLANTED = 10, 0.08  # s


async def tapped_daemon(*, is_two: bool, planted: float) -> Taps:
    """Taps of a daemon that takes a time [s] longer for every frame of the panel."""
    program = (sys.executable, "-m", "benchmarks.latency.planted", planted)
    running = daemon_session("paper_plate", program=program, is_two=is_two)
    async with running as session:
        return await taps(session, COUNT, is_two=is_two)


@pytest.mark.parametrize("is_two", [False, True])
async def test_time_of_every_touch_holds_a_delay_of_the_daemon(is_two: bool) -> None:
    """Each set that is counted answers its own touch; with two contents, the later of both."""
    found = await tapped_daemon(is_two=is_two, planted=PLANTED)
    assert found.unanswered == 0
    assert found.times.min() > PLANTED
    assert found.times.min() > found.wire > 0


async def test_baseline_answers_every_touch() -> None:
    """Plain asyncio, which computes nothing, on the same line."""
    async with plain_session("paper_plate") as session:
        found = await taps(session, COUNT)
    assert found.unanswered == 0
    assert 0 < found.times.min() < found.times.max()
