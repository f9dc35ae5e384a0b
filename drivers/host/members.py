"""The amplifiers of a group: which reply, which are lost, and requests to all of them at once."""

import asyncio
import math
from collections.abc import Awaitable, Callable, Coroutine, Mapping, Sequence
from typing import Any, TypeVar

from drivers import clock
from drivers.errors import LinkError, LinkTimeout, Preempted
from drivers.host.amplifier import Amplifier
from drivers.protocol.records import Values

_REPEAT_INTERVAL = 0.005  # s; in addition to the time in which a reply is awaited
_T = TypeVar("_T")


class Members:
    """Amplifiers by name, and the stops, disarms and closes of all of them."""

    def __init__(self, amplifiers: Mapping[str, Amplifier]) -> None:
        self.amplifiers = dict(amplifiers)
        self.silences = 0
        """Stops, disarms and closes so far."""
        self.silencing = 0
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
        return min((each.feeding.may_play_until for each in mute), default=math.inf)

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
        """Raise Preempted if a silence was asked for since there were so many."""
        if self.silences != before:
            raise Preempted(
                "amplifiers were disarmed, stopped or closed meanwhile; arm again if that is still "
                "wanted"
            )

    async def silenced(self, work: Coroutine[Any, Any, _T]) -> _T:
        """Await a stop or disarm to its end, whoever is cancelled; nothing arms meanwhile."""
        self.silencing += 1
        try:
            return await _to_completion(work)
        finally:
            self.silencing -= 1

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
        """Return results; raises the most severe error: a lost link first, a degraded one last."""
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
            return 2
        return 0 if isinstance(error, LinkError) else 1


def is_lost(amplifier: Amplifier) -> bool:
    """Whether it cannot be reached: its line is gone, or it is mute beyond its watchdog."""
    is_over = clock.now() >= amplifier.feeding.may_play_until
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


async def _to_completion(work: Coroutine[Any, Any, _T]) -> _T:
    """Await work, however often the caller is cancelled meanwhile; re-raise that at the end."""
    task = asyncio.ensure_future(work)
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
