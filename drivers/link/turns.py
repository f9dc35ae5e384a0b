"""Whose turn it is on a link that carries one request at a time.

Stops come first, then what else silences, then the others in order. One apply waits at most: a
newer one takes its place, and a request that silences drops it; a stop drops acknowledgements,
which were not meant for it. What has its turn gives way to what comes before it: at once while none
of it is on the wire, else after a moment; what silences is repeated then.
"""

import asyncio
from collections import deque
from collections.abc import Callable, Hashable
from enum import Enum, auto
from types import TracebackType
from typing import final

from drivers.errors import CommandRefused

# s; how long silence waits for the answer to something else: most answers are there by then, and
# with a ramp of 10 ms all is silent within 20 ms.
PATIENCE = 0.008

SUPERSEDED = "superseded by a newer set, or by a stop or disarm"


class RequestPriority(Enum):
    """How a request stands to the others that wait."""

    ORDINARY = auto()
    CLEAR = auto()
    APPLY = auto()
    SILENCE = auto()
    STOP = auto()

    @property
    def silences(self) -> bool:
        """Whether it goes before what does not."""
        return self is RequestPriority.SILENCE or self is RequestPriority.STOP

    def precedes(self, other: "RequestPriority") -> bool:
        """Whether it goes before one of another kind that came earlier."""
        return self is RequestPriority.STOP is not other or (self.silences and not other.silences)

    def voids(self, other: "RequestPriority") -> bool:
        """Whether one of another kind that waits is not wanted any more once this has come."""
        if other is RequestPriority.CLEAR:
            return self is RequestPriority.STOP
        return other is RequestPriority.APPLY and (self is RequestPriority.APPLY or self.silences)


class Preempted(CommandRefused):
    """Something that goes before it has taken its turn, or made it void."""


@final
class Turns:
    """Hands the link from one request to the next.

    is_unsent: whether nothing of what has the turn has gone out yet, and stays here if its task is
    cancelled now; by default all has gone out at once.
    """

    def __init__(self, is_unsent: Callable[[], bool] = lambda: False) -> None:
        self._is_unsent = is_unsent
        self._taken = False
        self._stops: deque[asyncio.Future[None]] = deque()
        self._silences: deque[asyncio.Future[None]] = deque()
        self._others: deque[asyncio.Future[None]] = deque()
        self._voidable: dict[asyncio.Future[None], RequestPriority] = {}  # of the others
        self._present: _Turn | None = None
        self._awaited: list[tuple[Hashable, RequestPriority]] = []

    @property
    def is_taken(self) -> bool:
        """Whether somebody has the turn."""
        return self._taken

    def raise_if_overtaken(self, kind: RequestPriority) -> None:
        """Raise Preempted where a request that has the turn must not be repeated in it.

        Something that goes before it waits, or for an apply a newer one.
        """
        if self._is_behind(kind) or (
            kind is RequestPriority.APPLY and kind in self._voidable.values()
        ):
            raise Preempted(SUPERSEDED)

    def take(self, kind: RequestPriority) -> "_Turn":
        """A context: waits for the turn and holds it; Preempted for what gave way."""
        return _Turn(self, kind)

    def is_kept_from_own(self, who: Hashable, kind: RequestPriority) -> bool:
        """Whether what silences this one itself is awaited, and goes before one of a kind."""
        return any(one == who and awaited.precedes(kind) for one, awaited in self._awaited)

    def preempt_unsent(self) -> None:
        """End the present turn if nothing of it has gone out, unless it silences."""
        turn = self._present
        if turn is not None and not turn.kind.silences and self._is_unsent():
            turn.preempt()

    def keep_free(self, who: Hashable, kind: RequestPriority) -> None:
        """Give no turn to what a request of this one's that is to come, and silences, goes before.

        kind: of that request; until `release`, as often.
        """
        self._awaited.append((who, kind))
        self._limit_turn()

    def release(self, who: Hashable, kind: RequestPriority) -> None:
        """It is answered, or will not come."""
        self._awaited.remove((who, kind))
        if not self._taken:
            self._pass_on()

    async def come(self, kind: RequestPriority) -> None:
        """Wait for the turn; for `_Turn`."""
        self._drop_what_is_void(kind)
        if self._taken or self._is_kept_from(kind):
            await self._wait(kind)
        self._taken = True

    def begin(self, turn: "_Turn") -> None:
        """The turn has begun."""
        self._present = turn

    def end(self) -> None:
        """The turn is over."""
        self._present = None
        self._pass_on()

    def _is_behind(self, kind: RequestPriority) -> bool:
        """Whether something waits that goes before one of a kind."""
        return (bool(self._stops) and RequestPriority.STOP.precedes(kind)) or (
            bool(self._silences) and RequestPriority.SILENCE.precedes(kind)
        )

    def _is_kept_from(self, kind: RequestPriority) -> bool:
        """Whether something waits, or is awaited, that goes before one of a kind."""
        return self._is_behind(kind) or any(one.precedes(kind) for _, one in self._awaited)

    def _limit_turn(self) -> None:
        """Let the present turn end now or soon if something before it waits, else when it likes."""
        turn = self._present
        if turn is None:
            return
        if self._is_kept_from(turn.kind) and self._is_unsent():
            turn.preempt()
        elif self._is_behind(turn.kind):
            turn.limit(PATIENCE)
        else:
            turn.let_be()

    def _queue_of(self, kind: RequestPriority) -> "deque[asyncio.Future[None]]":
        return {RequestPriority.STOP: self._stops, RequestPriority.SILENCE: self._silences}.get(
            kind, self._others
        )

    def _queue_up(self, kind: RequestPriority, *, at_first: bool) -> "asyncio.Future[None]":
        """What is done when the turn of a request has come."""
        turn = asyncio.get_running_loop().create_future()
        queue = self._queue_of(kind)
        if at_first:
            queue.appendleft(turn)
        else:
            queue.append(turn)
        if any(one.voids(kind) for one in RequestPriority):
            self._voidable[turn] = kind
        return turn

    async def _wait(self, kind: RequestPriority) -> None:
        turn = self._queue_up(kind, at_first=False)
        self._limit_turn()
        try:
            await turn
            while self._is_kept_from(kind):  # by what came while the turn was being handed over
                before = (
                    RequestPriority.STOP
                    if self._is_kept_from(RequestPriority.SILENCE)
                    else RequestPriority.SILENCE
                )
                if before.voids(kind):
                    self._pass_on()
                    raise Preempted(SUPERSEDED)
                turn = self._queue_up(kind, at_first=True)
                self._pass_on()
                await turn
        except asyncio.CancelledError:
            if not turn.cancelled() and turn.exception() is None:
                # The turn was handed over in the very moment of the cancellation.
                self._pass_on()
            elif turn in (queue := self._queue_of(kind)):
                queue.remove(turn)
                self._limit_turn()
            raise
        finally:
            self._voidable.pop(turn, None)

    def _drop_what_is_void(self, kind: RequestPriority) -> None:
        """Refuse what waits and is not wanted any more once one of this kind has come."""
        for turn in [turn for turn, waiting in self._voidable.items() if kind.voids(waiting)]:
            del self._voidable[turn]
            self._others.remove(turn)
            if not turn.done():  # it may have been cancelled and not run since
                turn.set_exception(Preempted(SUPERSEDED))

    def _next(self) -> "deque[asyncio.Future[None]]":
        """Those of whom the first may come now."""
        if self._is_kept_from(RequestPriority.SILENCE):
            return self._stops
        return self._silences if self._is_kept_from(RequestPriority.ORDINARY) else self._others

    def _pass_on(self) -> None:
        """Hand the turn, which nobody has, to the next."""
        while queue := self._next():
            turn = queue.popleft()
            self._voidable.pop(turn, None)
            if not turn.done():
                self._taken = True
                turn.set_result(None)
                return
        self._taken = False


@final
class _Turn:
    """A turn, from when it comes until the context ends."""

    __slots__ = ("_cancelling", "_is_preempted", "_task", "_timer", "_turns", "kind")

    def __init__(self, turns: Turns, kind: RequestPriority) -> None:
        self._turns = turns
        self.kind = kind
        self._timer: asyncio.TimerHandle | None = None
        self._is_preempted = False

    async def __aenter__(self) -> None:
        await self._turns.come(self.kind)
        task = asyncio.current_task()
        assert task is not None  # noqa: S101  a coroutine that waits is in one
        self._task = task
        self._cancelling = task.cancelling()
        self._turns.begin(self)

    async def __aexit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.let_be()
        self._turns.end()
        if not self._is_preempted:
            return
        is_ours = self._task.uncancel() <= self._cancelling  # nobody else has cancelled it as well
        if is_ours and kind is asyncio.CancelledError:
            raise Preempted(SUPERSEDED) from error

    def preempt(self) -> None:
        """End now."""
        self.let_be()
        if not self._is_preempted:
            self._is_preempted = True
            self._task.cancel()

    def limit(self, seconds: float) -> None:
        """End when so long [s] has passed, unless it is limited already."""
        if self._timer is None and not self._is_preempted:
            self._timer = asyncio.get_running_loop().call_later(seconds, self.preempt)

    def let_be(self) -> None:
        """End whenever it likes."""
        timer, self._timer = self._timer, None
        if timer is not None:
            timer.cancel()
