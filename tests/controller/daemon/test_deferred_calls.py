"""Calls of observers a moment later, or all at once."""

import asyncio

from controller.daemon.deferred_calls import DeferredCalls
from virtual_loop import in_virtual_time


@in_virtual_time
async def test_flush_makes_each_call_once() -> None:
    """In order, with those that are added meanwhile; nothing is left for the event loop."""
    problems: list[object] = []
    asyncio.get_running_loop().set_exception_handler(lambda _, context: problems.append(context))
    calls, made = DeferredCalls(), list[int]()
    calls.add(lambda: made.append(1))
    calls.add(lambda: calls.add(lambda: made.append(3)))
    calls.add(lambda: made.append(2))
    calls.flush()
    await asyncio.sleep(1.0)
    assert made == [1, 2, 3]
    assert not problems
