"""The amplifiers of a group: which reply, which are lost, which of several errors counts.

Their stops and disarms are begun at once, and go on to their end.
"""

import asyncio
import math
from collections.abc import Awaitable, Callable, Coroutine, Mapping, Sequence
from operator import attrgetter
from typing import Any, ParamSpec, TypeVar, cast

from drivers.errors import LinkError, LinkTimeout, Preempted
from drivers.host.amplifier import Amplifier
from drivers.host.feeding import Stopped
from drivers.host.jobs import Priority
from drivers.host.line import Line
from drivers.protocol.records import Values
from registry import threads

_T = TypeVar("_T")
_P = ParamSpec("_P")
_REPEAT_INTERVAL = 0.005  # s; in addition to the time in which a reply is awaited
need, _lost_from = attrgetter("feeding.since"), attrgetter("feeding.lost_from")
_silence_cause = attrgetter("silence_cause")


class Members:
    """Amplifiers by name, which is that of each."""

    def __init__(self, amplifiers: Mapping[str, Amplifier]) -> None:
        self.amplifiers = dict(amplifiers)
        self.epoch = 0
        """Stops, disarms and closes so far: nothing from before arms, plays or feeds after one."""
        self.has_joint_set = False
        """Whether they have a set that several lines are to play: no clock is read meanwhile."""
        self.gives_up_at = math.inf
        """When [s] nothing is repeated any more, since all is being closed."""
        self.silencing: set[asyncio.Future[Any]] = set()
        """Stops and disarms that go on."""
        self._broadcasts: dict[Line, asyncio.Future[Values]] = {}  # of stops

    @property
    def lines(self) -> tuple[Line, ...]:
        """Their lines, each once, in the order of the amplifiers, so that runs can be repeated."""
        return tuple(dict.fromkeys([each.line for each in self.amplifiers.values()]))

    @property
    def by_need(self) -> list[Amplifier]:
        """All, first the one that was fed longest ago: replies may come late."""
        return sorted(self.amplifiers.values(), key=need)

    @property
    def degraded(self) -> tuple[str, ...]:
        """Names of amplifiers that do not reply but may still play; nothing new is played then."""
        mute = filter(_silence_cause, self.amplifiers.values())
        return tuple([each.name for each in mute if not is_lost(each)])

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
        mute = filter(_silence_cause, self.amplifiers.values())
        return min(map(_lost_from, mute), default=math.inf)

    @property
    def last_sent_at(self) -> float:
        """When [s] a set or silence was last sent to any amplifier."""
        return max((each.played_at for each in self.amplifiers.values()), default=-math.inf)

    def check_none_since(self, before: int) -> None:
        """Raise Preempted if a stop, disarm or close has come since an epoch."""
        if self.epoch != before:
            raise Preempted(
                "amplifiers were disarmed, stopped or closed meanwhile; arm again if that is still "
                "wanted"
            )

    def is_degraded_only(self, error: BaseException) -> bool:
        """Whether an error says no more than that an amplifier does not reply for now."""
        return isinstance(error, LinkTimeout) and not self.lost_by

    async def all(self, requests: Sequence[Awaitable[_T]]) -> list[_T]:
        """Await all requests to their ends, then raise the most severe error."""
        return self.checked(await outcomes(requests))

    def checked(self, results: list[_T | BaseException]) -> list[_T]:
        """Return results; raises the most severe error.

        A lost link is first; last are what others have preempted and, after it, a degraded link.
        """
        if errors := [each for each in results if isinstance(each, BaseException)]:
            raise min(errors, key=self._severity)
        return cast("list[_T]", results)

    def _severity(self, error: BaseException) -> int:
        if self.is_degraded_only(error):
            return 3
        if isinstance(error, Preempted):  # by the cause, which is to be told
            return 2
        return 0 if isinstance(error, LinkError) else 1

    async def retried(self, amplifier: Amplifier, request: Callable[[], Awaitable[_T]]) -> _T:
        """Repeat a request until it is answered, the amplifier is lost, or all is being closed."""
        while True:
            try:
                return await request()
            except LinkTimeout:
                if is_lost(amplifier) or threads.now() > self.gives_up_at:
                    raise
                await asyncio.sleep(_REPEAT_INTERVAL)

    def silence(
        self, work: Callable[_P, Coroutine[Any, Any, _T]], *args: _P.args, **kwargs: _P.kwargs
    ) -> Coroutine[Any, Any, _T]:
        """Start a stop or disarm, which goes on to its end whatever is cancelled meanwhile."""
        task = asyncio.ensure_future(work(*args, **kwargs))  # begun wherever it was made
        self.silencing.add(task)
        task.add_done_callback(self.silencing.discard)
        return _to_completion(task)

    def broadcast_stop(self, line: Line, ramp: float) -> None:
        """Request a stop of all amplifiers of a line along a ramp [s], unless one is queued."""
        queued = self._broadcasts.get(line)
        if queued is None or queued.done():
            first = next(iter(self.amplifiers.values()))
            sent = line.submit(None, Priority.STOP, "Stop", {"ramp": first.wire_ramp(ramp)})
            # What each amplifier says afterwards decides.
            sent.add_done_callback(lambda sent: sent.cancelled() or sent.exception())
            self._broadcasts[line] = sent

    async def stopped(
        self, stops: Mapping[str, "asyncio.Future[Stopped]"]
    ) -> Mapping[str, Stopped]:
        """Await stops by name; of one that failed by itself it is said what it may play."""
        said: dict[str, Stopped] = {}
        for name, result in zip(stops, await outcomes([*stops.values()]), strict=True):
            if isinstance(result, BaseException):
                cause = f"{type(result).__name__}: {result}"
                result = self.amplifiers[name].what_may_play(cause)
            said[name] = result
        return said


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


async def outcomes(requests: Sequence[Awaitable[_T]]) -> list[_T | BaseException]:
    """Await all requests to their ends; returns the result or the error of each."""
    if len(requests) > 1:
        return await asyncio.gather(*requests, return_exceptions=True)
    results = list[_T | BaseException]()
    for request in requests:  # without a further iteration of the event loop
        try:
            results.append(await request)
        except Exception as error:
            results.append(error)
    return results


def is_lost(amplifier: Amplifier) -> bool:
    """Whether it cannot be reached: its line is gone, or it is mute beyond its watchdog."""
    if amplifier.silence_cause is None or amplifier.line.loss is not None:
        return amplifier.line.loss is not None
    return threads.now() >= amplifier.feeding.lost_from
