"""Waiting for a reply: in time, too late, and in a delayed process, in virtual time."""

import asyncio
from collections.abc import Sequence

import pytest

from drivers import clock
from drivers.backends.waiting import ReplyTimer
from virtual_loop import VirtualLoop, in_virtual_time, run_virtual


def stall(duration: float) -> None:
    """Let this process not run for a time [s]."""
    loop = asyncio.get_running_loop()
    assert isinstance(loop, VirtualLoop)
    loop.now += duration


@in_virtual_time
async def test_wait_returns_a_reply_or_times_out() -> None:
    """A missing reply is a TimeoutError when it is due, and ends the future."""
    loop = asyncio.get_running_loop()
    there: asyncio.Future[str] = loop.create_future()
    there.set_result("here")
    assert await ReplyTimer().wait(there, 60.0) == "here"
    missing: asyncio.Future[str] = loop.create_future()
    began = clock.now()
    with pytest.raises(TimeoutError):
        await ReplyTimer().wait(missing, 0.03)
    assert clock.now() == began + 0.03
    assert missing.done()


@pytest.mark.parametrize(
    ("stalls", "read_at"),
    [
        ([], 0.03),  # in the turn of the loop in which it is due
        ([0.05], 0.035),  # by a thread, after a stall beyond its timeout
        ([0.05, 0.05, 0.05], 0.14),  # after several in turn
    ],
)
def test_reply_that_came_in_time_counts_however_late_it_is_read(
    stalls: Sequence[float], read_at: float
) -> None:
    """Of 30 ms, in a process that does not run for 50 ms once or several times."""

    async def run() -> str:
        loop = asyncio.get_running_loop()
        reply: asyncio.Future[str] = loop.create_future()
        waiting = loop.create_task(ReplyTimer().wait(reply, 0.03))
        await asyncio.sleep(0)
        loop.call_later(read_at, reply.set_result, "here")
        for duration in stalls:
            stall(duration)
            await asyncio.sleep(0.001)
        return await waiting

    assert run_virtual(run()) == "here"


def test_reply_that_never_comes_is_given_up_however_late_this_process_is() -> None:
    """After a bounded number of looks, in a process that is delayed at each of them."""

    async def run() -> float:
        loop = asyncio.get_running_loop()
        waiting = loop.create_task(ReplyTimer().wait(loop.create_future(), 0.03))
        began = clock.now()
        while not waiting.done():
            await asyncio.sleep(0.001)
            stall(0.05)
        with pytest.raises(TimeoutError):
            await waiting
        return clock.now() - began

    assert 0.03 < run_virtual(run()) < 0.6


async def test_cancelled_wait_ends_at_once() -> None:
    """Cancelling ends the wait and the future."""
    reply: asyncio.Future[str] = asyncio.get_running_loop().create_future()
    waiting = asyncio.create_task(ReplyTimer().wait(reply, 60.0))
    await asyncio.sleep(0)
    waiting.cancel()
    with pytest.raises(asyncio.CancelledError):
        await waiting
    assert reply.cancelled()


@in_virtual_time
async def test_timer_of_an_earlier_reply_does_not_end_a_later_one() -> None:
    """Every reply has its own time, whichever was awaited first: each ends when it is due."""
    loop = asyncio.get_running_loop()
    timer, begin = ReplyTimer(), clock.now()
    there: asyncio.Future[str] = loop.create_future()
    there.set_result("here")
    await timer.wait(there, 0.005)
    ended: dict[float, float] = {}

    async def wait(timeout: float) -> None:
        reply: asyncio.Future[str] = loop.create_future()
        with pytest.raises(TimeoutError):
            await timer.wait(reply, timeout)
        ended[timeout] = clock.now() - begin

    await asyncio.gather(wait(0.03), wait(0.01))
    assert ended == {0.01: pytest.approx(0.01), 0.03: pytest.approx(0.03)}


def test_reply_in_another_loop_times_out() -> None:
    """A line that is opened again waits no longer, though its first loop ended with a timer set."""
    timer = ReplyTimer()

    async def wait(*, is_there: bool) -> None:
        reply: asyncio.Future[str] = asyncio.get_running_loop().create_future()
        if is_there:
            reply.set_result("here")
        await timer.wait(reply, 0.02)

    run_virtual(wait(is_there=True))
    with pytest.raises(TimeoutError):
        run_virtual(wait(is_there=False))
