"""Three firmware processes on terminals in real time, held by the same control loop.

Their clocks are judged by the machine's: each status by the middle of its exchange, of those that
took least time.
"""

import asyncio
import statistics
from collections.abc import Mapping
from contextlib import AsyncExitStack

from benchmarks.clocks.session import NAMES, make_controller, make_rig
from drivers.host.amplifier import Amplifier
from drivers.protocol.definition import ahead, clock_at
from drivers.protocol.records import Values
from registry import threads
from sim.simulation import find_firmware, running_firmware

_JUDGED = 10  # exchanges with the shortest times: one in so many


class _Readings:
    """What the clock of an amplifier shows in its statuses: time of the exchange, lead [s]."""

    def __init__(self, amplifier: Amplifier) -> None:
        self.taken: list[tuple[float, float]] = []
        self._note = amplifier.note_reply
        amplifier.note_reply = self._take  # type: ignore[method-assign]

    def _take(self, name: str, values: Values, reply: Values, sent_at: float) -> None:
        now = threads.now()
        if "clock" in reply:
            middle = clock_at((sent_at + now) / 2)
            self.taken.append((now - sent_at, ahead(reply["clock"], middle)))
        self._note(name, values, reply, sent_at)

    def lead(self) -> tuple[float, float]:
        """Return the lead of the clock and half the time of the exchanges that tell it [s]."""
        prompt = sorted(self.taken)[: max(len(self.taken) // _JUDGED, 1)]
        return statistics.median([lead for _, lead in prompt]), prompt[-1][0] / 2


async def firmware_skew(seconds: float) -> tuple[float, float]:
    """Return the rms of one clock in the last half of a time, and how well it is known [s]."""
    readings: list[_Readings] = []

    def watch(amplifiers: Mapping[str, Amplifier]) -> None:
        readings.extend(map(_Readings, amplifiers.values()))

    async with AsyncExitStack() as stack:
        urls = {
            name: await stack.enter_async_context(running_firmware(find_firmware(), name))
            for name in NAMES
        }
        controller = make_controller(make_rig(NAMES), urls, connected=watch)
        await controller.open()
        loop = asyncio.create_task(controller.cycle.run())
        await controller.arm()
        for is_judged in (False, True):
            await asyncio.sleep(seconds / 2)
            if not is_judged:
                for each_clock in readings:
                    each_clock.taken.clear()
        await controller.close()
        await loop
    leads, errors = zip(*[each.lead() for each in readings], strict=True)
    return statistics.stdev(leads), max(errors)
