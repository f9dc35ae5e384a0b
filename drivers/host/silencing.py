"""Stops and disarms of all amplifiers: each is begun at once and goes on to its end."""

import asyncio
from collections.abc import Callable, Coroutine, Mapping
from typing import Any, ParamSpec, TypeVar

from drivers.host.amplifier import Amplifier
from drivers.host.feeding import Stopped
from drivers.host.jobs import Priority
from drivers.host.line import Line
from drivers.host.members import outcomes
from drivers.protocol.records import Values

_T = TypeVar("_T")
_P = ParamSpec("_P")


class Silencing:
    """Stops and disarms in progress, of amplifiers by name."""

    def __init__(self, amplifiers: Mapping[str, Amplifier]) -> None:
        self._amplifiers = amplifiers
        self._tasks: set[asyncio.Future[Any]] = set()
        self._broadcasts: dict[Line, asyncio.Future[Values]] = {}  # of stops

    def __bool__(self) -> bool:
        """Whether a stop or disarm goes on."""
        return bool(self._tasks)

    def start(
        self, work: Callable[_P, Coroutine[Any, Any, _T]], *args: _P.args, **kwargs: _P.kwargs
    ) -> Coroutine[Any, Any, _T]:
        """Start a stop or disarm, which goes on to its end whatever is cancelled meanwhile."""
        task = asyncio.ensure_future(work(*args, **kwargs))  # begun wherever it was made
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
        return _to_completion(task)

    async def ended(self) -> None:
        """Wait until what goes on has ended."""
        if self._tasks:
            await asyncio.wait({*self._tasks})

    def broadcast(self, line: Line, ramp: float) -> None:
        """Request a stop of all amplifiers of a line along a ramp [s], unless one is queued."""
        queued = self._broadcasts.get(line)
        if queued is None or queued.done():
            first = next(iter(self._amplifiers.values()))
            sent = line.submit(None, Priority.STOP, "Stop", {"ramp": first.wire_ramp(ramp)})
            # What each amplifier says afterwards decides.
            sent.add_done_callback(lambda sent: sent.cancelled() or sent.exception())
            self._broadcasts[line] = sent

    async def outcomes(
        self, stops: Mapping[str, "asyncio.Future[Stopped]"]
    ) -> Mapping[str, Stopped]:
        """Await stops by name; of one that failed by itself it is said what it may play."""
        said: dict[str, Stopped] = {}
        for name, result in zip(stops, await outcomes([*stops.values()]), strict=True):
            if isinstance(result, BaseException):
                cause = f"{type(result).__name__}: {result}"
                result = self._amplifiers[name].what_may_play(cause)
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
