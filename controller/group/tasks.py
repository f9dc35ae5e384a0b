"""Awaiting requests to several amplifiers at once."""

import asyncio
from collections.abc import Awaitable, Callable, Coroutine, Iterable
from typing import Any, TypeVar, final

from drivers.errors import LinkError

_T = TypeVar("_T")


@final
class CoalescedCalls:
    """Runs an action at least once after each request for it, never twice at a time.

    All requests that arrive while it runs share one further run.
    """

    def __init__(self, action: Callable[[], Awaitable[object]]) -> None:
        self._action = action
        self._running = asyncio.Lock()
        self._next: asyncio.Task[None] | None = None

    def request(self) -> "asyncio.Task[None]":
        """Return the run that starts next; it raises what the action raises."""
        if self._next is None:
            self._next = asyncio.ensure_future(self._run())
        return self._next

    async def _run(self) -> None:
        async with self._running:
            self._next = None
            await self._action()


async def gather_all(requests: Iterable[Coroutine[Any, Any, _T]]) -> list[_T]:
    """Await all, then raise the most severe error: a LinkError before any other.

    A single request is awaited directly, without a further iteration of the event loop.
    """
    pending = list(requests)
    if len(pending) == 1:
        return [await pending[0]]
    results = await asyncio.gather(*pending, return_exceptions=True)
    failures = [result for result in results if isinstance(result, BaseException)]
    if failures:
        raise next((error for error in failures if isinstance(error, LinkError)), failures[0])
    return [result for result in results if not isinstance(result, BaseException)]


async def run_to_completion(work: Coroutine[Any, Any, None]) -> None:
    """Await work, however often the caller is cancelled meanwhile; re-raise that at the end."""
    task = asyncio.ensure_future(work)
    cancellation = None
    while not task.done():
        try:
            await asyncio.wait({task})
        except asyncio.CancelledError as error:
            cancellation = error
    if cancellation is not None:
        raise cancellation
    task.result()
