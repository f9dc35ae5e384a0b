"""Holding sets back until every channel has room for another voice (see `PlayRecord.room_from`)."""

import asyncio
from collections.abc import Awaitable, Callable
from contextlib import suppress
from typing import final

from drivers import clock
from drivers.errors import Preempted
from drivers.guard import SafeCommandSet
from drivers.line.sender import SUPERSEDED


@final
class Pacing:
    """The sets of one amplifier: of those that wait, only the newest is sent."""

    def __init__(self) -> None:
        self._sets = 0
        self._changed = asyncio.Event()

    def notice(self) -> None:
        """Let a set that waits look again: a reply has come."""
        self._changed.set()

    def supersede(self) -> None:
        """End the wait of a set, because of a newer one, silence or a stop."""
        self._sets += 1
        self._changed.set()

    async def wait_for_room(
        self, safe: SafeCommandSet, feed: Callable[[], Awaitable[object]], *, interval: float
    ) -> None:
        """Wait until a set would not be refused, with `feed` called every interval [s].

        Raises Preempted if it is superseded.
        """
        self.supersede()
        number, fed = self._sets, clock.now()
        while (left := safe.record.room_from(safe) - clock.now()) > 0:
            self._changed.clear()
            with suppress(TimeoutError):
                async with asyncio.timeout(min(left, max(0.0, fed + interval - clock.now()))):
                    await self._changed.wait()
            if clock.now() >= fed + interval:
                fed = clock.now()
                await feed()
            if number != self._sets:
                raise Preempted(SUPERSEDED)
