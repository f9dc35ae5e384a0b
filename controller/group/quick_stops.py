"""Quick stops of all amplifiers of a rig, however many ask for them."""

import asyncio
from collections.abc import Collection, Sequence
from contextlib import suppress
from functools import partial

from controller.group.tasks import CoalescedCalls
from drivers.amplifier import Amplifier
from drivers.errors import LinkError


class QuickStops:
    """QuickStops amplifiers once more for all who request it while they are being stopped.

    Those that share a bus are told by one frame before each of them is asked, so that none of them
    waits for the answer of another.
    """

    def __init__(self, amplifiers: Collection[Amplifier]) -> None:
        self._on_buses = [
            CoalescedCalls(partial(_tell, several)) for several in _sharing_a_bus(amplifiers)
        ]
        self._of_each = [(amplifier, CoalescedCalls(amplifier.stop)) for amplifier in amplifiers]

    def request(self) -> "list[asyncio.Task[None]]":
        """What stops all that can be reached, to be waited for; raises what that raises."""
        reachable = [stop for amplifier, stop in self._of_each if not amplifier.is_lost]
        return [stop.request() for stop in (*self._on_buses, *reachable)]


def _sharing_a_bus(amplifiers: Collection[Amplifier]) -> list[list[Amplifier]]:
    """Those that one broadcast reaches, where it reaches several."""
    buses: dict[str, list[Amplifier]] = {}
    for amplifier in amplifiers:
        if amplifier.bus is not None:
            buses.setdefault(amplifier.bus, []).append(amplifier)
    return [several for several in buses.values() if len(several) > 1]


async def _tell(several: Sequence[Amplifier]) -> None:
    """Stop all on a bus, by the link of one that is not lost if there is one; nobody answers."""
    with suppress(LinkError):  # whoever can be reached is asked as well, and tells
        await next((each for each in several if not each.is_lost), several[0]).stop_on_bus()
