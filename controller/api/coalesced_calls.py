"""Runs of one action that requests share."""

import asyncio
from collections.abc import Awaitable, Callable
from typing import Generic, TypeVar, final

_T = TypeVar("_T")


@final
class CoalescedCalls(Generic[_T]):
    """Runs an action after each request, one run at a time.

    All requests that arrive while it runs share one further run.
    """

    def __init__(self) -> None:
        self._running = asyncio.Lock()
        self._next: asyncio.Task[_T] | None = None

    def request(self, action: Callable[[], Awaitable[_T]]) -> "asyncio.Task[_T]":
        """Return the run that starts next, of this action or one requested before.

        It raises what the action raises. Shared: shield it from the cancellation of one caller.
        """
        if self._next is None or self._next.done():  # done without having begun
            self._next = asyncio.ensure_future(self._run(action))
        return self._next

    async def _run(self, action: Callable[[], Awaitable[_T]]) -> _T:
        async with self._running:
            self._next = None
            return await action()
