"""Quick stops of all amplifiers of a rig, coalesced over concurrent requests."""

import asyncio
from collections.abc import Collection, Sequence
from contextlib import suppress
from functools import partial

from controller.group.tasks import CoalescedCalls
from drivers.amplifier import Amplifier
from drivers.errors import LinkError


class QuickStops:
    """Stops every amplifier once more for all requests that arrive while it is being stopped.

    Amplifiers that share a bus get one broadcast before each of them is stopped by itself, so that
    none waits for the reply of another.
    """

    def __init__(self, amplifiers: Collection[Amplifier]) -> None:
        self._broadcasts = [
            CoalescedCalls(partial(_broadcast, sharing)) for sharing in _by_shared_bus(amplifiers)
        ]
        self._stops = [(amplifier, CoalescedCalls(amplifier.stop)) for amplifier in amplifiers]

    def request(self) -> "list[asyncio.Task[None]]":
        """Return the tasks that stop all amplifiers that are not lost; they raise DriverError."""
        reachable = [stop for amplifier, stop in self._stops if not amplifier.is_lost]
        return [stop.request() for stop in (*self._broadcasts, *reachable)]


def _by_shared_bus(amplifiers: Collection[Amplifier]) -> list[list[Amplifier]]:
    """Group the amplifiers that one broadcast reaches, where it reaches several."""
    buses: dict[str, list[Amplifier]] = {}
    for amplifier in amplifiers:
        if amplifier.bus is not None:
            buses.setdefault(amplifier.bus, []).append(amplifier)
    return [sharing for sharing in buses.values() if len(sharing) > 1]


async def _broadcast(sharing: Sequence[Amplifier]) -> None:
    """Stop all amplifiers of a bus over the link of one that is not lost, if there is one."""
    with suppress(LinkError):  # the stop of each amplifier reports it
        await next((each for each in sharing if not each.is_lost), sharing[0]).stop_on_bus()
