"""Stops of all amplifiers of a plate, repeated until each is silent or must be."""

import asyncio
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from drivers.host.amplifier import Amplifier, Stopped
from drivers.host.jobs import Priority
from drivers.host.line import Line
from drivers.host.members import seen
from drivers.protocol.records import Values

_logger = logging.getLogger(__name__)


@dataclass
class _Stop:
    """A stop of one amplifier; is_sent: whether its first request has gone out."""

    task: "asyncio.Future[Stopped] | None" = None
    is_sent: bool = False

    def sent(self) -> None:
        """Note that its request has gone out: later ones need a stop of their own."""
        self.is_sent = True


class Stopping:
    """Stops amplifiers, by name. All requests that come before a stop has gone out share it.

    Those of one line get a broadcast first, so that none waits for the reply of another.
    """

    def __init__(self, amplifiers: Mapping[str, Amplifier]) -> None:
        self._amplifiers = amplifiers
        self._stops: dict[str, _Stop] = {}
        self._broadcasts: dict[Line, asyncio.Future[Values]] = {}

    async def stop(
        self, ramp: float, *, waits_for: Sequence[str] | None = None
    ) -> dict[str, Stopped]:
        """Stop all along a ramp [s]; return what became of those of some names, None for all.

        Never raises an Exception.
        """
        tasks = {name: self._stop(name, ramp) for name in self._amplifiers}  # begin a moment later
        for line in {each.line for each in self._amplifiers.values()}:
            if len(line.members) > 1:
                try:
                    self._broadcast(line, ramp)
                except Exception:  # each amplifier is stopped by itself as well
                    _logger.exception("%s: the broadcast of a stop failed", line.name)
        names = [*tasks] if waits_for is None else [*waits_for]
        results = await asyncio.gather(
            *(asyncio.shield(tasks[name]) for name in names), return_exceptions=True
        )
        return {
            name: self._outcome(name, result) for name, result in zip(names, results, strict=True)
        }

    def _broadcast(self, line: Line, ramp: float) -> None:
        queued = self._broadcasts.get(line)
        if queued is None or queued.done():
            first = next(iter(self._amplifiers.values()))
            values = {"ramp": first.wire_ramp(ramp)}
            sent = line.submit(None, Priority.STOP, "Stop", values)
            sent.add_done_callback(seen)
            self._broadcasts[line] = sent

    def _stop(self, name: str, ramp: float) -> "asyncio.Future[Stopped]":
        current = self._stops.get(name)
        running = None if current is None or current.is_sent else current.task
        if running is not None and not running.done():
            return running
        stop = self._stops[name] = _Stop()
        stop.task = asyncio.ensure_future(self._amplifiers[name].stop(ramp, on_sent=stop.sent))
        return stop.task

    def _outcome(self, name: str, result: Stopped | BaseException) -> Stopped:
        if isinstance(result, Stopped):
            return result
        until = self._amplifiers[name].feeding.may_play_until
        return Stopped(False, until, f"{type(result).__name__}: {result}")
