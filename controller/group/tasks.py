"""Waiting for several amplifiers at once."""

import asyncio
from collections.abc import Awaitable, Callable, Coroutine, Iterable
from typing import Any, TypeVar, final

from drivers.errors import LinkError

_T = TypeVar("_T")


@final
class CoalescedCalls:
    """Does something so that it begins after each request, one after the other.

    However many requests come while it is being done, it is done once more for all of them.
    """

    def __init__(self, do: Callable[[], Awaitable[object]]) -> None:
        self._do = do
        self._doing = asyncio.Lock()
        self._next: asyncio.Task[None] | None = None

    def request(self) -> "asyncio.Task[None]":
        """The one that begins next; raises what that raises."""
        if self._next is None:
            self._next = asyncio.ensure_future(self._begin())
        return self._next

    async def _begin(self) -> None:
        async with self._doing:
            self._next = None
            await self._do()


async def gather_all(requests: Iterable[Coroutine[Any, Any, _T]]) -> list[_T]:
    """Wait for all, then raise the gravest of what they raised: a lost link before a refusal.

    A single one goes out at once, without a turn of the event loop in between.
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
    """See work through, however often the caller is cancelled meanwhile; that is raised then."""
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
