"""Waiting for a reply, with allowance for delays of this process."""

import asyncio
from typing import TypeVar

DUPLICATE_WAIT = 0.02  # s; for a second amplifier of the same address to reply
_LATE = 0.005  # s; a timer later than this means that this process was delayed
_GRACE = 0.010  # s; for data received but not read yet, here or in a reader thread

_T = TypeVar("_T")


async def reply_within(reply: "asyncio.Future[_T]", timeout: float) -> _T:
    """Return the reply; TimeoutError if it does not arrive within the timeout [s].

    A reply that arrived in time counts even if this process was delayed and reads it late.
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
        if reply.done() and not reply.cancelled():
            reply.exception()  # it counts as retrieved where this wait was cancelled
