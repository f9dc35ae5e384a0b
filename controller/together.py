"""Waiting for several amplifiers at once."""

import asyncio
from collections.abc import Awaitable, Coroutine, Iterable
from typing import Any, TypeVar

from drivers.errors import LinkError

_T = TypeVar("_T")


async def gathered(requests: Iterable[Coroutine[Any, Any, _T]]) -> list[_T]:
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


async def to_the_end(work: Awaitable[None]) -> None:
    """See work through, however often the caller is cancelled meanwhile; that is raised afterwards.

    work: a coroutine, or a task that others see through as well.
    """
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
