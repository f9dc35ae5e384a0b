"""The sender of one physical line: one task at a time, one priority queue.

A line carries one exchange at a time: on a free line in its caller's task, without an iteration of
the event loop in between, else in a task that lives while requests are queued. A queued request is
sent, superseded or withdrawn; one on the line is answered, times out, or is abandoned for a
stop-class request: at once if nothing of it was sent, else after a grace period.
"""

import asyncio
from collections.abc import Awaitable, Callable
from itertools import count
from typing import Any, TypeVar, cast, final
from weakref import WeakKeyDictionary, WeakValueDictionary

from drivers import clock
from drivers.backend import Backend
from drivers.errors import Preempted
from drivers.line import priority as priorities
from drivers.line.priority import Priority

MAX_WAIT = 0.05
"""Time [s] after which a queued request goes before newer heartbeats and sets; readings never."""

SUPERSEDED = "superseded by a newer set, or by a stop or disarm"

_T = TypeVar("_T")


class Retry(Exception):
    """Raised by an attempt to be made again, at the earliest after a pause [s]."""

    def __init__(self, pause: float = 0.0) -> None:
        super().__init__(pause)
        self.pause = pause


@final
class _Entry:
    """A request from its queueing to its result.

    number: order among requests of one amplifier; attempt_number: order among amplifiers, and
    started_at [s]: of the current attempt; not_before [s]: of the next one.
    """

    __slots__ = (
        "attempt",
        "attempt_number",
        "backend",
        "is_withdrawn",
        "not_before",
        "number",
        "priority",
        "queued_at",
        "result",
        "started_at",
    )

    def __init__(
        self,
        backend: Backend,
        priority: Priority,
        attempt: Callable[[], Awaitable[Any]],
        number: int,
    ) -> None:
        self.backend = backend
        self.priority = priority
        self.attempt = attempt
        self.number = self.attempt_number = number
        self.not_before = 0.0
        self.queued_at = clock.now()
        self.result: asyncio.Future[Any] = asyncio.get_running_loop().create_future()
        self.is_withdrawn = False
        self.started_at = self.queued_at

    @property
    def is_unsent(self) -> bool:
        """Whether nothing of the current attempt was sent."""
        return self.backend.last_sent_at < self.started_at

    def rank(self, now: float) -> int:
        """Place in the queue at a time [s]; one that has waited long is a heartbeat's equal."""
        rank = self.priority.rank
        has_waited = self.priority.gains_rank and now - self.queued_at > MAX_WAIT
        return min(rank, Priority.HEARTBEAT) if has_waited else rank

    def fail(self, error: BaseException) -> None:
        """End it, unless its caller has gone."""
        if not self.result.done():
            self.result.set_exception(error)


@final
class Sender:
    """Sends the requests of all amplifiers on a line by their priorities."""

    def __init__(self) -> None:
        self._queue: list[_Entry] = []
        self._numbers = count()
        self._task: asyncio.Task[Any] | None = None  # in which requests are sent
        self._current: _Entry | None = None
        self._is_preempted = False
        self._grace: asyncio.TimerHandle | None = None
        self._pause: asyncio.Future[None] | None = None

    @property
    def is_in_use(self) -> bool:
        """Whether an exchange is on the line."""
        return self._current is not None

    async def send(
        self, backend: Backend, priority: Priority, attempt: Callable[[], Awaitable[_T]]
    ) -> _T:
        """Queue a request of an amplifier and return the result of its last attempt.

        attempt: sends it and awaits its reply; raises `Retry` to be repeated. Raises Preempted if
        another request of this amplifier supersedes it, or precedes its repetition.
        """
        entry = _Entry(backend, priority, attempt, next(self._numbers))
        for queued in [*self._queue]:
            if queued.backend is backend and priority.supersedes(queued.priority):
                self._queue.remove(queued)
                queued.fail(Preempted(SUPERSEDED))
        if not self._is_serving and not self._queue:
            await self._send_first(entry)
            if entry.result.done():
                return cast(_T, entry.result.result())
        else:
            self._enqueue(entry)
        try:
            return cast(_T, await entry.result)
        except asyncio.CancelledError:
            if entry is self._current:
                self._preempt()
            elif entry in self._queue:
                self._queue.remove(entry)
                self._update_preemption()
            raise

    def abort_unsent(self, backend: Backend) -> None:
        """Discard the unsent requests of an amplifier and retry none, except stop-class ones.

        Requests on the line keep waiting for their replies.
        """
        for queued in [*self._queue]:
            if queued.backend is backend and not queued.priority.is_stop_class:
                self._queue.remove(queued)
                queued.fail(Preempted(SUPERSEDED))
        current = self._current
        if current and current.backend is backend and not current.priority.is_stop_class:
            current.is_withdrawn = True
            if current.is_unsent:
                self._preempt()

    def _enqueue(self, entry: _Entry) -> None:
        self._queue.append(entry)
        if self._is_serving:
            self._wake()
        else:
            self._start()
        self._update_preemption()

    @property
    def _is_serving(self) -> bool:
        """Whether a task sends what is queued; not one that an exception has ended."""
        return self._task is not None and not self._task.done()

    def _start(self) -> None:
        """Send what is queued in a task of its own."""
        self._task = asyncio.get_running_loop().create_task(self._send_queued())

    async def _send_first(self, entry: _Entry) -> None:
        """Make the first attempt in the caller's task."""
        self._task = asyncio.current_task()
        try:
            await self._carry_out(entry)
        finally:
            self._task = None
            if self._queue:
                self._start()

    async def _send_queued(self) -> None:
        entry: _Entry | None = None
        try:
            while self._queue:
                entry = self._next()
                if entry.not_before > clock.now():
                    await self._wait(entry.not_before)
                    continue
                self._queue.remove(entry)
                if not entry.result.done():
                    entry.started_at = clock.now()
                    await self._carry_out(entry)
        except Exception as error:  # a bug: no caller may wait indefinitely
            for left in (entry, *self._queue):
                if left is not None:
                    left.fail(error)
            raise
        finally:
            self._task = None
            for entry in self._queue:  # only where the event loop ends
                entry.result.cancel()
            self._queue.clear()

    def _next(self) -> _Entry:
        """Return the next request: the first of the first of each amplifier.

        It may have to pause; a stop-class request does so even if others are ready.
        """
        if len(self._queue) == 1:
            return self._queue[0]
        now = clock.now()
        firsts: dict[Backend, _Entry] = {}
        for entry in sorted(self._queue, key=lambda one: (one.rank(now), one.number)):
            firsts.setdefault(entry.backend, entry)
        first = min(firsts.values(), key=lambda one: (one.rank(now), one.attempt_number))
        if first.not_before <= now or first.priority.is_stop_class:
            return first
        ready = [entry for entry in firsts.values() if entry.not_before <= now]
        if not ready:
            return min(firsts.values(), key=lambda one: one.not_before)
        return min(ready, key=lambda one: (one.rank(now), one.attempt_number))

    async def _wait(self, until: float) -> None:
        """Wait until a time [s] or until a request is queued."""
        loop = asyncio.get_running_loop()
        self._pause = pause = loop.create_future()
        timer = loop.call_at(until, self._wake)
        try:
            await pause
        finally:
            timer.cancel()
            self._pause = None

    def _wake(self) -> None:
        """End a pause of the task."""
        if self._pause is not None and not self._pause.done():
            self._pause.set_result(None)

    async def _carry_out(self, entry: _Entry) -> None:
        """Make one attempt."""
        self._current, self._is_preempted = entry, False
        task = cast("asyncio.Task[Any]", self._task)
        cancellations = task.cancelling()
        try:
            result = await entry.attempt()
        except asyncio.CancelledError:
            if not self._is_preempted or task.uncancel() > cancellations:
                entry.result.cancel()
                raise
            self._repeat(entry, 0.0)
        except Retry as retry:
            self._end_preemption(task, cancellations)
            self._repeat(entry, retry.pause)
        except Exception as error:
            self._end_preemption(task, cancellations)
            entry.fail(error)
        else:
            self._end_preemption(task, cancellations)
            if not entry.result.done():
                entry.result.set_result(result)
        finally:
            self._current = None
            self._cancel_grace()

    def _end_preemption(self, task: "asyncio.Task[Any]", cancellations: int) -> None:
        """Take back a cancellation that came too late for an attempt."""
        if self._is_preempted and task.cancelling() > cancellations:
            task.uncancel()

    def _repeat(self, entry: _Entry, pause: float) -> None:
        """Queue a request again, unless another one precedes it."""
        if entry.result.done():
            return
        is_overtaken = any(
            queued.priority.preempts(entry.priority) or queued.priority.supersedes(entry.priority)
            for queued in self._queue
            if queued.backend is entry.backend
        )
        if not entry.priority.is_stop_class and (entry.is_withdrawn or is_overtaken):
            entry.fail(Preempted(SUPERSEDED))
            return
        entry.attempt_number = next(self._numbers)
        entry.not_before = clock.now() + pause if pause else 0.0
        self._queue.append(entry)

    def _update_preemption(self) -> None:
        """Abandon the exchange on the line now, later, or not, by the queued priorities."""
        current = self._current
        if current is None:
            return
        if not any(queued.priority.preempts(current.priority) for queued in self._queue):
            self._cancel_grace()
        elif current.is_unsent:
            self._preempt()
        elif self._grace is None:
            loop = asyncio.get_running_loop()
            self._grace = loop.call_later(priorities.PREEMPTION_GRACE, self._preempt)

    def _preempt(self) -> None:
        """Abandon the exchange on the line."""
        self._cancel_grace()
        if self._task is not None and not self._is_preempted:
            self._is_preempted = True
            self._task.cancel()

    def _cancel_grace(self) -> None:
        grace, self._grace = self._grace, None
        if grace is not None:
            grace.cancel()


_SENDERS: "WeakKeyDictionary[asyncio.AbstractEventLoop, WeakValueDictionary[str, Sender]]" = (
    WeakKeyDictionary()
)


def sender_of(backend: Backend) -> Sender:
    """Return the sender of a backend's line in the running event loop.

    One for all amplifiers of its bus, except on a multi-master bus: there each has its own.
    """
    if backend.bus is None or backend.wire_times.is_multi_master:
        return Sender()
    senders = _SENDERS.setdefault(asyncio.get_running_loop(), WeakValueDictionary())
    sender = senders.get(backend.bus)
    if sender is None:
        sender = senders[backend.bus] = Sender()
    return sender
