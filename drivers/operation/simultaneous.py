"""Letting amplifiers on different links begin at one moment, as far as their wires allow.

Nobody but the wire knows when a commit arrives, and a slow one takes longer. What is known by
arithmetic is made up for; what remains is how far apart the operating system lets bytes go out.
"""

from asyncio import sleep
from collections.abc import Awaitable, Callable, Coroutine, Sequence
from typing import Any

from drivers import clock

_SLACK = 0.002  # s; timers wake up to so much late, so the rest of a wait is spent awake


def at_one_moment(
    commits: Sequence[tuple[float, Callable[[], Awaitable[object]]]],
) -> list[Coroutine[Any, Any, object]]:
    """Commits, each with its time [s] on the wire, as what to run so that all arrive together.

    The one whose wire takes longest goes first, the others later by what theirs take less.
    """
    by_time = sorted(commits, key=lambda commit: -commit[0])
    arrival = clock.now() + max((takes for takes, _ in by_time), default=0.0)
    return [_commit_at(arrival - takes, commit) for takes, commit in by_time]


async def _commit_at(moment: float, commit: Callable[[], Awaitable[object]]) -> object:
    before = None
    while (left := moment - clock.now()) > 0:
        # A clock that stands still while others run is virtual, and its timers are exact.
        await sleep(left if left == before else max(0.0, left - _SLACK))
        before = left
    return await commit()
