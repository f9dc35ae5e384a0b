"""Awaiting requests to several amplifiers at once."""

import asyncio
from collections.abc import Awaitable, Callable, Coroutine, Iterable
from typing import Any, Generic, TypeVar, final

from drivers.errors import LinkDegraded, LinkError

_REPEAT_INTERVAL = 0.005  # s; in addition to the time in which each reply is awaited

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


async def gather_all(requests: Iterable[Coroutine[Any, Any, _T]]) -> list[_T]:
    """Await all, then raise the most severe error: a lost link first, a degraded one last.

    A single request is awaited directly, without a further iteration of the event loop.
    """
    pending = list(requests)
    if len(pending) == 1:
        return [await pending[0]]
    results = await asyncio.gather(*pending, return_exceptions=True)
    failures = [result for result in results if isinstance(result, BaseException)]
    if failures:
        raise min(failures, key=_severity)
    return [result for result in results if not isinstance(result, BaseException)]


def _severity(error: BaseException) -> int:
    """Rank an error, the most severe first."""
    if isinstance(error, LinkDegraded):
        return 2
    return 0 if isinstance(error, LinkError) else 1


async def retry_while_degraded(request: Callable[[], Awaitable[_T]]) -> _T:
    """Repeat a request on a degraded link until it is answered or the link is lost."""
    while True:
        try:
            return await request()
        except LinkDegraded:
            await asyncio.sleep(_REPEAT_INTERVAL)


async def run_to_completion(work: Coroutine[Any, Any, _T]) -> _T:
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
    return task.result()
