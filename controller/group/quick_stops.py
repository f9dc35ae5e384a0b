"""Quick stops of all amplifiers of a rig, repeated until each is silent or must be."""

import asyncio
import logging
from collections.abc import Mapping, Sequence
from contextlib import suppress
from functools import partial

from controller.group.tasks import CoalescedCalls
from drivers.amplifier import Amplifier
from drivers.operation.silence import SilenceStatus, StopOutcome, stop_and_confirm

_logger = logging.getLogger(__name__)


class QuickStops:
    """Stops every amplifier once more for all requests that arrive while it is being stopped.

    The first of these is sent at once, before the previous stop is confirmed; no clear or other
    request that was queued is sent before it.

    Lost amplifiers are sent stops as long as their wires are open. Amplifiers that share a bus
    get one broadcast before each of them is stopped individually, so that none waits for the reply
    of another.
    """

    def __init__(self, amplifiers: Mapping[str, Amplifier]) -> None:
        self._amplifiers = amplifiers
        self._broadcasts = [
            (CoalescedCalls[None](), sharing) for sharing in _by_shared_bus(amplifiers)
        ]
        self._requested = {name: asyncio.Event() for name in amplifiers}
        self._stops = {name: CoalescedCalls[StopOutcome]() for name in amplifiers}

    async def stop(self, *, waits_for_lost: bool = True) -> dict[str, StopOutcome]:
        """Stop all amplifiers; returns the outcome of each, by name. Never raises an Exception.

        waits_for_lost: else returns once those are stopped whose link is not lost.
        """
        for amplifier in self._amplifiers.values():
            with suppress(Exception):  # the stop does not depend on it
                amplifier.expect_stop()
        for broadcasts, sharing in self._broadcasts:
            broadcasts.request(partial(_broadcast, sharing))
        for requested in self._requested.values():
            requested.set()
        stops = {
            name: self._stops[name].request(
                partial(stop_and_confirm, amplifier, requested=self._requested[name])
            )
            for name, amplifier in self._amplifiers.items()
        }
        names = [name for name in stops if waits_for_lost or not self._amplifiers[name].is_lost]
        outcomes = await asyncio.gather(
            *(self._outcome(name, stops[name]) for name in names), return_exceptions=True
        )
        return dict(zip(names, map(_known, outcomes), strict=True))

    async def _outcome(self, name: str, stop: "asyncio.Task[StopOutcome]") -> StopOutcome:
        """Await a stop; after an unexpected exception stop once more."""
        try:
            return await asyncio.shield(stop)
        except Exception:
            _logger.exception("amplifier %s: stop failed, stopping again", name)
            return await stop_and_confirm(self._amplifiers[name])


def _known(outcome: StopOutcome | BaseException) -> StopOutcome:
    """The outcome of a stop; MAY_PLAY if it raised."""
    if isinstance(outcome, StopOutcome):
        return outcome
    return StopOutcome(SilenceStatus.MAY_PLAY, None, f"{type(outcome).__name__}: {outcome}")


def _by_shared_bus(amplifiers: Mapping[str, Amplifier]) -> list[list[Amplifier]]:
    """Group the amplifiers that one broadcast reaches, where it reaches several."""
    buses: dict[str, list[Amplifier]] = {}
    for amplifier in amplifiers.values():
        if amplifier.bus is not None:
            buses.setdefault(amplifier.bus, []).append(amplifier)
    return [sharing for sharing in buses.values() if len(sharing) > 1]


async def _broadcast(sharing: Sequence[Amplifier]) -> None:
    """Stop all amplifiers of a bus over the link of one that is not lost, if there is one."""
    try:
        await next((each for each in sharing if not each.is_lost), sharing[0]).stop_on_bus()
    except Exception as error:  # each amplifier is stopped individually as well
        _logger.debug("amplifiers: broadcast stop failed: %s", error)
