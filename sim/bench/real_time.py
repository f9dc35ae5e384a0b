"""The bench and the clock: here simulated time is tied to time.monotonic().

That clock is the same in all processes of a machine, so a host can name moments to the far end.
"""

import asyncio

from drivers import clock
from sim.bench.bench import Bench

TICK = 0.01  # s; how far the plate may lag behind when nobody asks for anything


async def keep_time(bench: Bench) -> None:
    """Advance the bench with the clock until cancelled."""
    while True:
        bench.advance(clock.now())
        await asyncio.sleep(TICK)
