"""Waiting for a reply: in time, too late, and in a delayed process."""

import asyncio
import os
import time

import pytest

from drivers.backends.waiting import ReplyTimer


async def test_wait_returns_a_reply_or_times_out() -> None:
    """A missing reply is a TimeoutError and ends the future."""
    loop = asyncio.get_running_loop()
    there: asyncio.Future[str] = loop.create_future()
    there.set_result("here")
    assert await ReplyTimer().wait(there, 60.0) == "here"
    missing: asyncio.Future[str] = loop.create_future()
    with pytest.raises(TimeoutError):
        await ReplyTimer().wait(missing, 0.001)
    assert missing.done()


async def test_reply_counts_when_the_process_was_delayed() -> None:
    """A reply in the pipe at the timeout is in time."""
    loop = asyncio.get_running_loop()
    reply: asyncio.Future[bytes] = loop.create_future()
    reading, writing = os.pipe()
    loop.add_reader(reading, lambda: reply.set_result(os.read(reading, 16)))
    try:
        waiting = asyncio.create_task(ReplyTimer().wait(reply, 0.002))
        await asyncio.sleep(0)
        os.write(writing, b"here")
        time.sleep(0.004)  # noqa: ASYNC251  the process is held up, past the time
        assert await waiting == b"here"
    finally:
        loop.remove_reader(reading)
        os.close(reading)
        os.close(writing)


async def test_reply_counts_when_the_reader_thread_was_delayed() -> None:
    """A reply posted a little later is in time."""
    loop = asyncio.get_running_loop()
    reply: asyncio.Future[str] = loop.create_future()
    waiting = asyncio.create_task(ReplyTimer().wait(reply, 0.002))
    await asyncio.sleep(0)
    time.sleep(0.02)  # noqa: ASYNC251  held up
    # As a thread posts that runs once the process runs again: after the timer has been seen.
    loop.call_soon(lambda: loop.call_soon(lambda: reply.done() or reply.set_result("late")))
    assert await waiting == "late"


async def test_cancelled_wait_ends_at_once() -> None:
    """Cancelling ends the wait and the future."""
    reply: asyncio.Future[str] = asyncio.get_running_loop().create_future()
    waiting = asyncio.create_task(ReplyTimer().wait(reply, 60.0))
    await asyncio.sleep(0)
    waiting.cancel()
    with pytest.raises(asyncio.CancelledError):
        await waiting
    assert reply.cancelled()


async def test_timer_of_an_earlier_reply_does_not_end_a_later_one() -> None:
    """Every reply has its own time, whichever was awaited first: each ends when it is due."""
    loop = asyncio.get_running_loop()
    timer, begin = ReplyTimer(), loop.time()
    there: asyncio.Future[str] = loop.create_future()
    there.set_result("here")
    await timer.wait(there, 0.005)
    ended: dict[float, float] = {}

    async def wait(timeout: float) -> None:
        reply: asyncio.Future[str] = loop.create_future()
        with pytest.raises(TimeoutError):
            await timer.wait(reply, timeout)
        ended[timeout] = loop.time() - begin

    await asyncio.gather(wait(0.03), wait(0.01))
    assert list(ended) == [0.01, 0.03]
    assert all(after >= timeout for timeout, after in ended.items())


def test_reply_in_another_loop_times_out() -> None:
    """A line that is opened again waits no longer, though its first loop ended with a timer set."""
    timer = ReplyTimer()

    async def wait(*, is_there: bool) -> None:
        reply: asyncio.Future[str] = asyncio.get_running_loop().create_future()
        if is_there:
            reply.set_result("here")
        async with asyncio.timeout(10):
            await timer.wait(reply, 0.02)

    asyncio.run(wait(is_there=True))
    with pytest.raises(TimeoutError) as caught:
        asyncio.run(wait(is_there=False))
    assert caught.value.__cause__ is None  # of the reply, not of these ten seconds
