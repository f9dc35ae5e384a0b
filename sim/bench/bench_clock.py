"""Advance a bench with time.monotonic(), the same clock in all processes of a machine."""

import asyncio

from drivers import clock
from sim.bench.bench import Bench

TICK = 0.01  # s


async def keep_time(bench: Bench) -> None:
    """Advance the bench with the clock until cancelled."""
    while True:
        bench.advance(clock.now())
        await asyncio.sleep(TICK)
