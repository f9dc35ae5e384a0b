"""Whose turn it is on a link that carries one request at a time.

Requests that silence come first, then the others in order. One apply waits at most: a newer one
takes its place, and a request that silences drops it. What is on the wire when a request that
silences comes is waited for a moment only.
"""

import asyncio
from collections import deque
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from enum import Enum, auto

from drivers.errors import CommandRefused

# s; how long silence waits for the answer to something else: most answers are there by then, and
# with a ramp of 10 ms all is silent within 20 ms.
PATIENCE = 0.008

_SUPERSEDED = "superseded by a newer set, or by a stop or disarm"


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
        self._limit: asyncio.Timeout | None = None  # of the turn, unless it silences

    def raise_if_overtaken(self, kind: Kind) -> None:
        """Raise CommandRefused where a request that has the turn must not be repeated.

        Something that silences waits, or for an apply a newer one.
        """
        newer = kind is Kind.APPLY and self._apply is not None
        if newer or (self._silences and kind is not Kind.SILENCE):
            raise CommandRefused(_SUPERSEDED)

    @asynccontextmanager
    async def take(self, kind: Kind) -> AsyncIterator[None]:
        """Wait for the turn and hold it; raises CommandRefused for what gave way to another."""
        if kind is not Kind.ORDINARY:
            self._drop_apply()
        if self._taken:
            await self._wait(kind)
        self._taken = True
        try:
            if kind is Kind.SILENCE:
                yield
            else:
                async with self._limited():
                    yield
        finally:
            self._pass_on()

    @asynccontextmanager
    async def _limited(self) -> AsyncIterator[None]:
        """Hold the turn until a request that silences has waited for long enough."""
        limit = asyncio.timeout(PATIENCE if self._silences else None)
        try:
            async with limit as self._limit:
                yield
        except TimeoutError as problem:
            if limit.expired():
                raise CommandRefused(_SUPERSEDED) from problem
            raise
        finally:
            self._limit = None

    def _limit_turn(self) -> None:
        """Let the present turn end soon if a request that silences waits, else when it likes."""
        if self._limit is None or self._limit.expired():
            return
        if not self._silences:
            self._limit.reschedule(None)
        elif self._limit.when() is None:
            self._limit.reschedule(asyncio.get_running_loop().time() + PATIENCE)

    async def _wait(self, kind: Kind) -> None:
        turn = asyncio.get_running_loop().create_future()
        queue = self._silences if kind is Kind.SILENCE else self._others
        queue.append(turn)
        if kind is Kind.APPLY:
            self._apply = turn
        self._limit_turn()
        try:
            await turn
        except asyncio.CancelledError:
            if not turn.cancelled() and turn.exception() is None:
                # The turn was handed over in the very moment of the cancellation.
                self._pass_on()
            elif turn in queue:
                queue.remove(turn)
                self._limit_turn()
            raise
        finally:
            if self._apply is turn:
                self._apply = None

    def _drop_apply(self) -> None:
        waiting, self._apply = self._apply, None
        if waiting is not None:
            self._others.remove(waiting)
            if not waiting.done():  # it may have been cancelled and not run since
                waiting.set_exception(CommandRefused(_SUPERSEDED))

    def _pass_on(self) -> None:
        while queue := self._silences or self._others:
            turn = queue.popleft()
            if self._apply is turn:
                self._apply = None
            if not turn.done():
                turn.set_result(None)
                return
        self._taken = False
