"""The bench and the clock: here simulated time is tied to time.monotonic().

That clock is the same in all processes of a machine, so a host can name moments to the far end.
"""

import asyncio
from collections.abc import Callable
from typing import TypeAlias

from drivers import clock
from drivers.protocol.messages import Reply, Request
from sim.bench.bench import Bench

TICK = 0.01  # s; how far the plate may lag behind when nobody asks for anything

Exchange: TypeAlias = Callable[[Request], Reply]


async def keep_time(bench: Bench) -> None:
    """Advance the bench with the clock until cancelled."""
    while True:
        bench.advance(clock.now())
        await asyncio.sleep(TICK)


def exchange_with(bench: Bench, amplifier: str) -> Exchange:
    """How one amplifier of the bench answers a request at the moment at which it arrives."""

    def exchange(request: Request) -> Reply:
        return bench.exchange(amplifier, request, now=clock.now())

    return exchange
