"""The amplifiers of a group: which of them reply, and which are lost.

`Members` selects the most severe of several errors, and repeats requests to amplifiers that do not
reply. Stops and disarms start immediately and run to completion.
"""

import asyncio
import math
from collections.abc import Awaitable, Callable, Coroutine, Mapping, Sequence
from typing import Any, ParamSpec, TypeVar, cast

from drivers.errors import LinkError, LinkTimeout, Preempted
from drivers.host.amplifier import Amplifier
from drivers.host.line import Line
from drivers.host.requests import Priority
from drivers.host.stops import StopOutcome
from drivers.protocol.records import Values
from registry import threads

_T = TypeVar("_T")
_P = ParamSpec("_P")
_REPEAT_INTERVAL = 0.005  # s; in addition to the time in which a reply is awaited


class Members:
    """The amplifiers of a group, by name."""

    def __init__(self, amplifiers: Mapping[str, Amplifier]) -> None:
        self.amplifiers = dict(amplifiers)
        self.epoch = 0
        """Number of stops, disarms and closes; what began before one must not arm, play or feed."""
        self.gives_up_at = math.inf
        """When requests are no longer repeated [s], because all is being closed."""
        self.disarming: set[asyncio.Future[Any]] = set()
        """Stops and disarms in progress; each leaves its amplifiers disarmed."""
        self._broadcasts: dict[Line, asyncio.Future[Values]] = {}  # the last stop of each line

    @property
    def lines(self) -> tuple[Line, ...]:
        """Each line once, in the order of the amplifiers, so that runs are reproducible."""
        return tuple(dict.fromkeys([amplifier.line for amplifier in self.amplifiers.values()]))

    @property
    def by_last_feeding(self) -> list[Amplifier]:
        """All amplifiers; the least recently fed is first, because replies may be late."""
        return sorted(self.amplifiers.values(), key=last_fed_at)

    @property
    def _mute(self) -> list[Amplifier]:
        """The amplifiers that do not reply."""
        return [amplifier for amplifier in self.amplifiers.values() if amplifier.no_reply_cause]

    @property
    def degraded(self) -> tuple[str, ...]:
        """Names of amplifiers that do not reply but may still play; nothing new is played then."""
        return tuple([amplifier.name for amplifier in self._mute if not is_lost(amplifier)])

    @property
    def lost_by(self) -> Mapping[str, str]:
        """Why each lost amplifier is lost, by name."""
        causes = {}
        for name, amplifier in self.amplifiers.items():
            if is_lost(amplifier):
                causes[name] = amplifier.line.loss or amplifier.no_reply_cause or ""
        return causes

    @property
    def lost_from(self) -> float:
        """When an amplifier that does not reply is lost [s]; the next beat then stops all."""
        times = [amplifier.feeding.lost_from for amplifier in self._mute]
        return min(times, default=math.inf)

    @property
    def last_sent_at(self) -> float:
        """When a set or silence was last sent to any amplifier [s]."""
        times = [amplifier.played_at for amplifier in self.amplifiers.values()]
        return max(times, default=-math.inf)

    def start_epoch(self) -> None:
        """Note a stop, disarm or close: what began before must not arm, play or feed."""
        self.epoch += 1

    def check_none_since(self, epoch: int) -> None:
        """Raise Preempted if a stop, disarm or close has come since an epoch."""
        if self.epoch != epoch:
            raise Preempted(
                "amplifiers were disarmed, stopped or closed meanwhile; arm again if that is still "
                "wanted"
            )

    def is_degraded_only(self, error: BaseException) -> bool:
        """Whether an error only means that an amplifier currently does not reply."""
        return isinstance(error, LinkTimeout) and not self.lost_by

    async def all(self, requests: Sequence[Awaitable[_T]]) -> list[_T]:
        """Await all requests to their ends, then raise the most severe error."""
        return self.checked(await outcomes(requests))

    def checked(self, results: list[_T | BaseException]) -> list[_T]:
        """Return results, or raise the most severe error among them.

        A lost link is the most severe; the least are a preempted request and a degraded link.
        """
        errors = [result for result in results if isinstance(result, BaseException)]
        if errors:
            raise min(errors, key=self._severity)
        return cast("list[_T]", results)

    def _severity(self, error: BaseException) -> int:
        if self.is_degraded_only(error):
            return 3
        if isinstance(error, Preempted):  # the user should see the error that preempted it
            return 2
        return 0 if isinstance(error, LinkError) else 1

    async def retried(self, amplifier: Amplifier, request: Callable[[], Awaitable[_T]]) -> _T:
        """Repeat a request until it has a reply, the amplifier is lost, or everything is closed."""
        while True:
            try:
                return await request()
            except LinkTimeout:
                if is_lost(amplifier) or threads.now() > self.gives_up_at:
                    raise
                await asyncio.sleep(_REPEAT_INTERVAL)

    def start_disarming(
        self, work: Callable[_P, Coroutine[Any, Any, _T]], *args: _P.args, **kwargs: _P.kwargs
    ) -> Coroutine[Any, Any, _T]:
        """Start a stop or disarm, which runs to completion in spite of cancellation."""
        task = asyncio.ensure_future(work(*args, **kwargs))  # starts even if not awaited
        self.disarming.add(task)
        task.add_done_callback(self.disarming.discard)
        return _to_completion(task)

    def broadcast_stop(self, line: Line, ramp: float) -> None:
        """Request a stop of all amplifiers of a line along a ramp [s], unless one is queued."""
        queued = self._broadcasts.get(line)
        if queued is None or queued.done():
            wire_ramp = 0  # each amplifier shortens a ramp that is too long for it
            for amplifier in self.amplifiers.values():
                if amplifier.line is line:
                    wire_ramp = max(wire_ramp, amplifier.wire_ramp(ramp))
            sent = line.submit(None, Priority.STOP, "Stop", {"ramp": wire_ramp})
            # Its error does not matter: the replies of the amplifiers to their own stops decide.
            sent.add_done_callback(lambda sent: sent.cancelled() or sent.exception())
            self._broadcasts[line] = sent

    async def stopped(
        self, stops: Mapping[str, "asyncio.Future[StopOutcome]"]
    ) -> Mapping[str, StopOutcome]:
        """Await stops by name; a failed stop gives the possible output of its amplifier."""
        stop_outcomes: dict[str, StopOutcome] = {}
        for name, result in zip(stops, await outcomes([*stops.values()]), strict=True):
            if isinstance(result, BaseException):
                cause = f"{type(result).__name__}: {result}"
                result = self.amplifiers[name].what_may_play(cause)
            stop_outcomes[name] = result
        return stop_outcomes


async def _to_completion(task: "asyncio.Future[_T]") -> _T:
    """Await a task to its end even if the caller is cancelled; then raise the cancellation."""
    cancellation = None
    while not task.done():
        try:
            await asyncio.wait({task})
        except asyncio.CancelledError as error:
            cancellation = error
    if cancellation is not None:
        task.exception()  # so that asyncio does not report it; the amplifiers' own errors are
        raise cancellation
    return task.result()


async def outcomes(requests: Sequence[Awaitable[_T]]) -> list[_T | BaseException]:
    """Await all requests to their ends; returns the result or the error of each."""
    return await asyncio.gather(*requests, return_exceptions=True)


def last_fed_at(amplifier: Amplifier) -> float:
    """Return when an amplifier's watchdog was last surely fed [s]."""
    return amplifier.feeding.fed_at


def is_lost(amplifier: Amplifier) -> bool:
    """Whether an amplifier cannot be reached: its line is gone, or it is mute past its watchdog."""
    if amplifier.no_reply_cause is None or amplifier.line.loss is not None:
        return amplifier.line.loss is not None
    return threads.now() >= amplifier.feeding.lost_from
