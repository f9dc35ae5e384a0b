"""The event loop in virtual time: its clock, and threads that work meanwhile."""

import asyncio
import threading
from collections.abc import Coroutine
from typing import Any, TypeVar

from registry.threads import in_thread
from registry.virtual_time import START, VirtualTimeLoop

T = TypeVar("T")


def run(main: Coroutine[Any, Any, T]) -> T:
    """Run a coroutine in virtual time."""
    with asyncio.Runner(loop_factory=VirtualTimeLoop) as runner:
        return runner.run(main)


def test_clock_jumps_to_each_timer_exactly() -> None:
    """An hour of waiting ends at the moment of the timer, to the last bit."""

    async def wait() -> float:
        await asyncio.sleep(3600.0)
        return asyncio.get_running_loop().time()

    assert run(wait()) == START + 3600.0


def test_clock_stands_still_while_a_thread_works() -> None:
    """A thread that works until the loop has had many turns; a timer of 1 ms does not fire."""
    is_over = threading.Event()
    fired = []

    async def work() -> float:
        loop = asyncio.get_running_loop()
        loop.call_later(0.001, fired.append, True)
        threading.Timer(0.1, is_over.set).start()
        await in_thread(is_over.wait, name="work")
        return loop.time()

    assert run(work()) == START
    assert not fired
