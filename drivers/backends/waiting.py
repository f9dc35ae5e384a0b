"""Waiting for a reply, with allowance for delays of this process."""

import asyncio
from typing import Any, TypeVar, final

DUPLICATE_WAIT = 0.02  # s; for a second amplifier of the same address to reply
_LATE = 0.005  # s; a timer later than this means that this process was delayed
_GRACE = 0.010  # s; for data received but not read yet in a reader thread, which was delayed, too
_MAX_LOOKS = 4  # for a reply at or after its timeout

_T = TypeVar("_T")


@final
class ReplyTimer:
    """The timeouts of the replies on one line, under one timer.

    Nearly every reply comes long before its timeout. So the timer is left as it is until then, and
    only set again if a reply is still awaited. A timeout is declared only after the line was read
    once more; if this process was delayed, after a pause in which it was not, or after the last of
    several looks.
    """

    def __init__(self) -> None:
        self._due: dict[asyncio.Future[Any], float] = {}  # s; of the awaited replies
        self._looks: dict[asyncio.Future[Any], int] = {}  # at those that are due
        self._timer: asyncio.TimerHandle | None = None
        self._loop: asyncio.AbstractEventLoop | None = None

    async def wait(self, reply: "asyncio.Future[_T]", timeout: float) -> _T:
        """Return the reply; TimeoutError if it does not arrive within the timeout [s].

        A reply that arrived in time counts even if this process was delayed and reads it late.
        """
        loop = asyncio.get_running_loop()
        due = self._due[reply] = loop.time() + timeout
        # The timer of a loop that has ended never fires.
        if self._timer is None or self._timer.when() > due or self._loop is not loop:
            self._loop = loop
            self._set(due)
        try:
            return await reply
        finally:
            del self._due[reply]
            self._looks.pop(reply, None)
            if reply.done() and not reply.cancelled():
                reply.exception()  # it counts as retrieved where this wait was cancelled

    def _set(self, due: float) -> None:
        if self._timer is not None:
            self._timer.cancel()
        self._timer = asyncio.get_running_loop().call_at(due, self._expire, due)

    def _expire(self, scheduled: float) -> None:
        """Give up the replies that are due by a scheduled time [s]."""
        self._timer = None
        now = asyncio.get_running_loop().time()
        for reply, due in [*self._due.items()]:
            if due > max(now, scheduled) or reply.done():
                continue
            was_delayed, looks = now - due > _LATE, self._looks.get(reply, 0)
            if looks == 0 or (was_delayed and looks < _MAX_LOOKS):
                self._looks[reply] = looks + 1
                self._due[reply] = now + (_GRACE if was_delayed else 0.0)
            else:
                reply.set_exception(TimeoutError())
        left = [due for reply, due in self._due.items() if not reply.done()]
        if left:
            self._set(min(left))
