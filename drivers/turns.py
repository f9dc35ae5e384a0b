"""Whose turn it is on a link that carries one request at a time.

Requests that silence come first, then the others in order. One apply waits at most: a newer one
takes its place, and a request that silences drops it.
"""

import asyncio
from collections import deque
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from enum import Enum, auto

from drivers.errors import CommandRefused


class Kind(Enum):
    """How a request stands to the others that wait."""

    ORDINARY = auto()
    APPLY = auto()
    SILENCE = auto()


class Turns:
    """Hands the link from one request to the next."""

    def __init__(self) -> None:
        self._taken = False
        self._silences: deque[asyncio.Future[None]] = deque()
        self._others: deque[asyncio.Future[None]] = deque()
        self._apply: asyncio.Future[None] | None = None

    @property
    def apply_overtaken(self) -> bool:
        """Whether an apply that has the turn need not be repeated: something newer waits."""
        return bool(self._silences) or self._apply is not None

    @asynccontextmanager
    async def take(self, kind: Kind) -> AsyncIterator[None]:
        """Wait for the turn and hold it; raises CommandRefused("superseded") for an apply."""
        if kind is not Kind.ORDINARY:
            self._drop_apply()
        if self._taken:
            await self._wait(kind)
        self._taken = True
        try:
            yield
        finally:
            self._pass_on()

    async def _wait(self, kind: Kind) -> None:
        turn = asyncio.get_running_loop().create_future()
        queue = self._silences if kind is Kind.SILENCE else self._others
        queue.append(turn)
        if kind is Kind.APPLY:
            self._apply = turn
        try:
            await turn
        except asyncio.CancelledError:
            if not turn.cancelled() and turn.exception() is None:
                # The turn was handed over in the very moment of the cancellation.
                self._pass_on()
            elif turn in queue:
                queue.remove(turn)
            raise
        finally:
            if self._apply is turn:
                self._apply = None

    def _drop_apply(self) -> None:
        waiting, self._apply = self._apply, None
        if waiting is not None:
            self._others.remove(waiting)
            if not waiting.done():  # it may have been cancelled and not run since
                waiting.set_exception(CommandRefused("superseded"))

    def _pass_on(self) -> None:
        while queue := self._silences or self._others:
            turn = queue.popleft()
            if self._apply is turn:
                self._apply = None
            if not turn.done():
                turn.set_result(None)
                return
        self._taken = False
