"""Priority queue for a link with one outstanding request.

Stop > stop-class (silent set, disarm) > others in order. At most one apply is queued: a newer one
or a stop-class request supersedes it; a stop supersedes queued acknowledgements of faults, too. A
lower-priority request in flight is preempted: at once if unsent, else after a grace period.
Preempted stop-class requests are retried.
"""

import asyncio
from collections import deque
from collections.abc import Callable, Hashable
from enum import Enum, auto
from types import TracebackType
from typing import final

from drivers.errors import CommandRefused

# s; how long a stop-class request waits for the reply to another one: most replies arrive
# within it, and with a ramp of 10 ms all channels are silent within 20 ms.
PREEMPTION_GRACE = 0.008

SUPERSEDED = "superseded by a newer set, or by a stop or disarm"


class RequestPriority(Enum):
    """Priority of a request on its link."""

    ORDINARY = auto()
    CLEAR = auto()
    APPLY = auto()
    SILENCE = auto()
    STOP = auto()

    @property
    def is_stop_class(self) -> bool:
        """Whether it silences the amplifier, and so outranks requests that do not."""
        return self is RequestPriority.SILENCE or self is RequestPriority.STOP

    def outranks(self, other: "RequestPriority") -> bool:
        """Whether it is sent before an earlier request of that priority."""
        return self is RequestPriority.STOP is not other or (
            self.is_stop_class and not other.is_stop_class
        )

    def supersedes(self, other: "RequestPriority") -> bool:
        """Whether this request makes a queued one of that priority obsolete."""
        if other is RequestPriority.CLEAR:
            return self is RequestPriority.STOP
        return other is RequestPriority.APPLY and (
            self is RequestPriority.APPLY or self.is_stop_class
        )


class Preempted(CommandRefused):
    """Raised in a request that was preempted or superseded."""


@final
class Turns:
    """Grants access to the link to one request at a time.

    is_unsent: whether nothing of the current request is on the wire yet, so that cancelling its
    task sends nothing; by default requests are on the wire at once.
    """

    def __init__(self, is_unsent: Callable[[], bool] = lambda: False) -> None:
        self._is_unsent = is_unsent
        self._is_in_use = False
        self._stops: deque[asyncio.Future[None]] = deque()
        self._stop_class: deque[asyncio.Future[None]] = deque()
        self._others: deque[asyncio.Future[None]] = deque()
        self._supersedable: dict[asyncio.Future[None], RequestPriority] = {}  # in _others
        self._current: _Access | None = None
        self._reservations: list[tuple[Hashable, RequestPriority]] = []

    @property
    def is_in_use(self) -> bool:
        """Whether the link is in use."""
        return self._is_in_use

    def raise_if_overtaken(self, priority: RequestPriority) -> None:
        """Raise Preempted if the current request must not be retried.

        A request that outranks it is queued, or for an apply a newer one.
        """
        if self._is_outranked_by_waiting(priority) or (
            priority is RequestPriority.APPLY and priority in self._supersedable.values()
        ):
            raise Preempted(SUPERSEDED)

    def take(self, priority: RequestPriority) -> "_Access":
        """Return a context that waits for access to the link and holds it; raises Preempted."""
        return _Access(self, priority)

    def has_own_reservation(self, owner: Hashable, priority: RequestPriority) -> bool:
        """Whether this owner has reserved the link for a request that outranks `priority`."""
        return any(
            holder == owner and reserved.outranks(priority)
            for holder, reserved in self._reservations
        )

    def preempt_unsent(self) -> None:
        """Preempt the current request if it is unsent and not of the stop class."""
        access = self._current
        if access is not None and not access.priority.is_stop_class and self._is_unsent():
            access.preempt()

    def reserve(self, owner: Hashable, priority: RequestPriority) -> None:
        """Reserve the link for a pending stop-class request of this owner.

        Blocks lower-priority requests until `release_reservation`; reservations are counted.
        """
        self._reservations.append((owner, priority))
        self._update_preemption()

    def release_reservation(self, owner: Hashable, priority: RequestPriority) -> None:
        """Release one reservation: its request is complete or was cancelled."""
        self._reservations.remove((owner, priority))
        if not self._is_in_use:
            self._wake_next()

    async def acquire(self, priority: RequestPriority) -> None:
        """Wait for the link; used by `_Access`."""
        self._drop_superseded(priority)
        if self._is_in_use or self._is_outranked(priority):
            await self._wait(priority)
        self._is_in_use = True

    def started(self, access: "_Access") -> None:
        """Note the request that uses the link now; used by `_Access`."""
        self._current = access

    def release(self) -> None:
        """Release the link and wake the next waiter."""
        self._current = None
        self._wake_next()

    def _is_outranked_by_waiting(self, priority: RequestPriority) -> bool:
        """Whether a queued request outranks one of this priority."""
        return (bool(self._stops) and RequestPriority.STOP.outranks(priority)) or (
            bool(self._stop_class) and RequestPriority.SILENCE.outranks(priority)
        )

    def _is_outranked(self, priority: RequestPriority) -> bool:
        """Whether a queued request or a reservation outranks one of this priority."""
        return self._is_outranked_by_waiting(priority) or any(
            reserved.outranks(priority) for _, reserved in self._reservations
        )

    def _update_preemption(self) -> None:
        """Preempt the current request, or restart or cancel its preemption timer."""
        access = self._current
        if access is None:
            return
        if self._is_outranked(access.priority) and self._is_unsent():
            access.preempt()
        elif self._is_outranked_by_waiting(access.priority):
            access.preempt_after(PREEMPTION_GRACE)
        else:
            access.cancel_timer()

    def _queue_of(self, priority: RequestPriority) -> "deque[asyncio.Future[None]]":
        return {RequestPriority.STOP: self._stops, RequestPriority.SILENCE: self._stop_class}.get(
            priority, self._others
        )

    def _enqueue(self, priority: RequestPriority, *, is_first: bool) -> "asyncio.Future[None]":
        """Enqueue a waiter."""
        waiter = asyncio.get_running_loop().create_future()
        queue = self._queue_of(priority)
        if is_first:
            queue.appendleft(waiter)
        else:
            queue.append(waiter)
        if any(one.supersedes(priority) for one in RequestPriority):
            self._supersedable[waiter] = priority
        return waiter

    async def _wait(self, priority: RequestPriority) -> None:
        waiter = self._enqueue(priority, is_first=False)
        self._update_preemption()
        try:
            await waiter
            # A request may arrive between the wake-up of a waiter and its next step.
            while self._is_outranked(priority):
                preempting = (
                    RequestPriority.STOP
                    if self._is_outranked(RequestPriority.SILENCE)
                    else RequestPriority.SILENCE
                )
                if preempting.supersedes(priority):
                    self._wake_next()
                    raise Preempted(SUPERSEDED)
                waiter = self._enqueue(priority, is_first=True)
                self._wake_next()
                await waiter
        except asyncio.CancelledError:
            if not waiter.cancelled() and waiter.exception() is None:
                # It was granted the link in the iteration in which it was cancelled.
                self._wake_next()
            elif waiter in (queue := self._queue_of(priority)):
                queue.remove(waiter)
                self._update_preemption()
            raise
        finally:
            self._supersedable.pop(waiter, None)

    def _drop_superseded(self, priority: RequestPriority) -> None:
        """Raise Preempted in queued requests that one of this priority supersedes."""
        for waiter in [
            waiter for waiter, queued in self._supersedable.items() if priority.supersedes(queued)
        ]:
            del self._supersedable[waiter]
            self._others.remove(waiter)
            if not waiter.done():  # it may have been cancelled and not run since
                waiter.set_exception(Preempted(SUPERSEDED))

    def _next_queue(self) -> "deque[asyncio.Future[None]]":
        """Return the highest-priority queue that may have the link now; it may be empty."""
        if self._is_outranked(RequestPriority.SILENCE):
            return self._stops
        return self._stop_class if self._is_outranked(RequestPriority.ORDINARY) else self._others

    def _wake_next(self) -> None:
        """Grant the free link to the next waiter, if any."""
        while queue := self._next_queue():
            waiter = queue.popleft()
            self._supersedable.pop(waiter, None)
            if not waiter.done():
                self._is_in_use = True
                waiter.set_result(None)
                return
        self._is_in_use = False


@final
class _Access:
    """Access to the link, from its grant until the context ends."""

    __slots__ = ("_cancelling", "_is_preempted", "_task", "_timer", "_turns", "priority")

    def __init__(self, turns: Turns, priority: RequestPriority) -> None:
        self._turns = turns
        self.priority = priority
        self._timer: asyncio.TimerHandle | None = None
        self._is_preempted = False

    async def __aenter__(self) -> None:
        await self._turns.acquire(self.priority)
        task = asyncio.current_task()
        assert task is not None  # noqa: S101  coroutines run in tasks
        self._task = task
        self._cancelling = task.cancelling()
        self._turns.started(self)

    async def __aexit__(
        self,
        error_type: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.cancel_timer()
        self._turns.release()
        if not self._is_preempted:
            return
        is_ours = self._task.uncancel() <= self._cancelling  # not cancelled by others as well
        if is_ours and error_type is asyncio.CancelledError:
            raise Preempted(SUPERSEDED) from error

    def preempt(self) -> None:
        """Cancel the request now; its context raises Preempted."""
        self.cancel_timer()
        if not self._is_preempted:
            self._is_preempted = True
            self._task.cancel()

    def preempt_after(self, seconds: float) -> None:
        """Start the preemption timer [s], unless it runs."""
        if self._timer is None and not self._is_preempted:
            self._timer = asyncio.get_running_loop().call_later(seconds, self.preempt)

    def cancel_timer(self) -> None:
        """Cancel the preemption timer."""
        timer, self._timer = self._timer, None
        if timer is not None:
            timer.cancel()
