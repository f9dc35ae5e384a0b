"""The amplifiers of a group: which reply, which are lost; requests, heartbeats, stops of all.

Heartbeats show as well that amplifiers still play what they should. A watchdog that runs down, and
starts anew with each of them, shows that it would silence the amplifier: so its status is read just
before it is fed. One that does not reply is not fed.
"""

import asyncio
import math
from collections.abc import Awaitable, Callable, Coroutine, Mapping, Sequence
from typing import Any, TypeVar

from drivers import clock
from drivers.errors import LinkError, LinkTimeout, Preempted
from drivers.host.amplifier import Amplifier
from drivers.host.jobs import Priority
from drivers.protocol.records import Values

_REPEAT_INTERVAL = 0.005  # s; in addition to the time in which a reply is awaited
_T = TypeVar("_T")


class Members:
    """Amplifiers by name, and the stops, disarms and closes of all of them."""

    def __init__(self, amplifiers: Mapping[str, Amplifier]) -> None:
        self.amplifiers = dict(amplifiers)
        self.epoch = 0
        """Stops, disarms and closes so far: nothing from before arms, plays or feeds after one."""
        self.silencing: set[asyncio.Future[Any]] = set()
        """Stops and disarms in progress."""

    @property
    def degraded(self) -> tuple[str, ...]:
        """Names of amplifiers that do not reply but may still play; nothing new is played then."""
        return tuple(
            name
            for name, each in self.amplifiers.items()
            if each.silence_cause is not None and not is_lost(each)
        )

    @property
    def lost_by(self) -> Mapping[str, str]:
        """Causes by name of amplifiers that must be silent without a reply, or without a line."""
        return {
            name: each.line.loss or each.silence_cause or ""
            for name, each in self.amplifiers.items()
            if is_lost(each)
        }

    @property
    def lost_from(self) -> float:
        """When [s] the next beat stops all, since one that does not reply must be silent."""
        mute = [each for each in self.amplifiers.values() if each.silence_cause is not None]
        return min((each.feeding.lost_from for each in mute), default=math.inf)

    @property
    def last_sent_at(self) -> float:
        """When [s] a set or silence was last sent to any amplifier."""
        return max((each.played_at for each in self.amplifiers.values()), default=-math.inf)

    def lose(self) -> None:
        """Note that one is lost."""

    def is_degraded_only(self, error: BaseException) -> bool:
        """Whether an error says no more than that an amplifier does not reply for now."""
        return isinstance(error, LinkTimeout) and not self.lost_by

    def note(self, error: BaseException) -> None:
        """Note an error of a request: it may show that an amplifier is lost."""
        if isinstance(error, LinkError) and not self.is_degraded_only(error):
            self.lose()

    def check_none_since(self, before: int) -> None:
        """Raise Preempted if a stop, disarm or close has come since an epoch."""
        if self.epoch != before:
            raise Preempted(
                "amplifiers were disarmed, stopped or closed meanwhile; arm again if that is still "
                "wanted"
            )

    def silenced(self, work: Coroutine[Any, Any, _T]) -> Coroutine[Any, Any, _T]:
        """Begin a stop or disarm; nothing arms until it ends, whoever is cancelled meanwhile."""
        task = asyncio.ensure_future(work)
        self.silencing.add(task)
        task.add_done_callback(self.silencing.discard)
        return _to_completion(task)

    async def all(self, requests: Sequence[Awaitable[_T]]) -> list[_T]:
        """Await all requests to their ends, then raise the most severe error."""
        try:
            if len(requests) == 1:  # without a further iteration of the event loop
                return [await requests[0]]
            results = await asyncio.gather(*requests, return_exceptions=True)
            return self.checked(results)
        except LinkError as error:
            self.note(error)
            raise

    def checked(self, results: Sequence[_T | BaseException]) -> list[_T]:
        """Return results; raises the most severe error.

        A lost link is first; last are what others have preempted and, after it, a degraded link.
        """
        good: list[_T] = []
        errors: list[BaseException] = []
        for each in results:
            if isinstance(each, BaseException):
                errors.append(each)
            else:
                good.append(each)
        if errors:
            raise min(errors, key=self._severity)
        return good

    def _severity(self, error: BaseException) -> int:
        if self.is_degraded_only(error):
            return 3
        if isinstance(error, Preempted):  # by the cause, which is to be told
            return 2
        return 0 if isinstance(error, LinkError) else 1


def is_lost(amplifier: Amplifier) -> bool:
    """Whether it cannot be reached: its line is gone, or it is mute beyond its watchdog."""
    is_over = clock.now() >= amplifier.feeding.lost_from
    return amplifier.line.loss is not None or (amplifier.silence_cause is not None and is_over)


async def retried(amplifier: Amplifier, request: Callable[[], Awaitable[_T]]) -> _T:
    """Repeat a request until it is answered or the amplifier is lost."""
    while True:
        try:
            return await request()
        except LinkTimeout:
            if is_lost(amplifier):
                raise
            await asyncio.sleep(_REPEAT_INTERVAL)


async def _to_completion(task: "asyncio.Future[_T]") -> _T:
    """Await work, however often the caller is cancelled meanwhile; re-raise that at the end."""
    cancellation = None
    while not task.done():
        try:
            await asyncio.wait({task})
        except asyncio.CancelledError as error:
            cancellation = error
    if cancellation is not None:
        task.exception()  # retrieved: what has failed is said by the amplifiers
        raise cancellation
    return task.result()


def seen(sent: "asyncio.Future[Values]") -> None:
    """Retrieve an error that nobody awaits: what each amplifier says afterwards decides."""
    if not sent.cancelled():
        sent.exception()


_MAX_STATUS_LOAD = 0.05  # of the line's time, for statuses that show whether the watchdog runs down


class Heartbeats:
    """Heartbeats of the amplifiers of a group."""

    def __init__(self, members: Members) -> None:
        self._members = members
        self._running_read_at: dict[str, float] = {}
        self._readings: dict[str, asyncio.Future[Values]] = {}  # of amplifiers that do not reply

    async def beat(self) -> None:
        """Feed the watchdog of every amplifier that replies, and read the status of the others.

        Raises LinkTimeout where one is lost, Preempted where they are armed no longer, and what
        the requests raise.
        """
        amplifiers = self._members.amplifiers.values()
        for amplifier in amplifiers:  # before the others are waited for: they are stopped then
            if is_lost(amplifier):
                raise LinkTimeout(amplifier.line.loss or amplifier.silence_cause)
        before = self._members.epoch
        await self._members.all([self._beat(each, before) for each in amplifiers])

    async def _beat(self, amplifier: Amplifier, before: int) -> None:
        name = amplifier.name
        if amplifier.silence_cause is None:
            # A status just before the watchdog is fed, unless the wire is too slow for that.
            pause = amplifier.exchange_time("Set") / _MAX_STATUS_LOAD
            if (now := clock.now()) - self._running_read_at.get(name, 0.0) >= pause:
                self._running_read_at[name] = now
                await amplifier.read_status(Priority.HEARTBEAT)
            self._members.check_none_since(before)
            await amplifier.ping()
        elif name not in self._readings or self._readings[name].done():
            reading = asyncio.ensure_future(amplifier.read_status(Priority.READING))
            reading.add_done_callback(seen)
            self._readings[name] = reading
