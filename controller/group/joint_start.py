"""A moment at which several tasks go on together."""

import asyncio
from collections.abc import Callable
from typing import final


@final
class JointStart:
    """Where so many tasks wait until all are ready; the last one goes on at once.

    start: called once, when all are ready; returns whether they go on.
    """

    def __init__(self, count: int, start: Callable[[], bool]) -> None:
        self._missing = count
        self._start = start
        self._goes_on = True
        self._is_decided = asyncio.Event()

    async def ready(self) -> bool:
        """Wait for the others; returns whether to go on: all are ready, and it has begun."""
        self._count()
        await self._is_decided.wait()
        return self._goes_on

    def fail(self) -> None:
        """Note that one will not be ready: none goes on."""
        self._goes_on = False
        self._count()

    def _count(self) -> None:
        self._missing -= 1
        if self._missing:
            return
        goes_on, self._goes_on = self._goes_on, False  # also where beginning fails
        try:
            self._goes_on = goes_on and self._start()
        finally:
            self._is_decided.set()
