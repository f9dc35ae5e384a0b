"""Waiting for a reply, and no longer than is fair to whoever owes it."""

import asyncio
from typing import TypeVar

SETTLE = 0.02  # s; time for a second amplifier of the same address to answer
_LATE = 0.005  # s; by so much a timer is late only where this process was held up
_GRACE = 0.010  # s; then what came meanwhile may lie unread, here or in a reader's thread

_T = TypeVar("_T")


async def reply_within(reply: "asyncio.Future[_T]", timeout: float) -> _T:
    """The reply; TimeoutError where it does not come within so long [s].

    One that has come counts, also where this process was held up and finds it after its time.
    """
    loop = asyncio.get_running_loop()
    due = loop.time() + timeout

    def give_up() -> None:
        if not reply.done():
            reply.set_exception(TimeoutError())

    def expire() -> None:
        if loop.time() - due > _LATE:
            loop.call_later(_GRACE, give_up)
        else:
            give_up()

    timer = loop.call_at(due, expire)
    try:
        return await reply
    finally:
        timer.cancel()
