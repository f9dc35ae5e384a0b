"""Simultaneous commits on different links, compensated for their wire times.

The remaining skew is that with which the operating system sends bytes.
"""

from asyncio import sleep
from collections.abc import Awaitable, Callable, Coroutine, Sequence
from typing import Any, TypeVar

from drivers import clock

_T = TypeVar("_T")
_SLACK = 0.002  # s; timers are up to this late, so the rest of a wait is polled


def simultaneous_commits(
    commits: Sequence[tuple[float, Callable[[], Awaitable[_T]]]],
) -> list[Coroutine[Any, Any, _T]]:
    """Schedule commits, each given with its wire time [s], so that all arrive together.

    Returns the coroutines to run concurrently, the slowest wire first.
    """
    by_time = sorted(commits, key=lambda commit: -commit[0])
    arrival = clock.now() + max((takes for takes, _ in by_time), default=0.0)
    return [commit_at(arrival - takes, commit) for takes, commit in by_time]


async def commit_at(moment: float, commit: Callable[[], Awaitable[_T]]) -> _T:
    """Send a commit at a time [s], and return its result."""
    before = None
    while (left := moment - clock.now()) > 0:
        # Virtual time stands still between two readings; its timers are exact.
        await sleep(left if left == before else max(0.0, left - _SLACK))
        before = left
    return await commit()
