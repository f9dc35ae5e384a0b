"""Stops and disarms of all amplifiers: each is begun at once and goes on to its end."""

import asyncio
import logging
from collections.abc import Callable, Coroutine, Mapping
from typing import Any, ParamSpec, TypeVar

from drivers.host.amplifier import Amplifier
from drivers.host.feeding import Stopped
from drivers.host.jobs import Priority
from drivers.host.line import Line
from drivers.protocol.records import Values

_T = TypeVar("_T")
_P = ParamSpec("_P")
_logger = logging.getLogger(__name__)


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

    def stop(self, ramp: float) -> dict[str, "asyncio.Future[Stopped]"]:
        """Queue a stop of every amplifier along a ramp [s]; nothing here fails or waits.

        Those of one line get a broadcast first, so that none waits for the reply of another.
        """
        for line in {each.line for each in self._amplifiers.values()}:
            if len(line.members) > 1:
                try:
                    self._broadcast(line, ramp)
                except Exception:  # each amplifier is stopped by itself as well
                    _logger.exception("%s: the broadcast of a stop failed", line.name)
        stops: dict[str, asyncio.Future[Stopped]] = {}
        for name, amplifier in self._amplifiers.items():
            try:
                stops[name] = amplifier.stop(ramp)
            except Exception as error:  # the others are stopped all the same
                stops[name] = asyncio.get_running_loop().create_future()
                stops[name].set_exception(error)
        return stops

    def _broadcast(self, line: Line, ramp: float) -> None:
        """Request a stop of all amplifiers of a line, unless one is queued."""
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
        outcomes: dict[str, Stopped] = {}
        for name, result in zip(
            stops, await asyncio.gather(*stops.values(), return_exceptions=True), strict=True
        ):
            if isinstance(result, BaseException):
                cause = f"{type(result).__name__}: {result}"
                result = self._amplifiers[name].what_may_play(cause)
            outcomes[name] = result
        return outcomes


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
