"""An amplifier behind a URL that is armed and plays one tone."""

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from drivers.contents import Layer, Tone
from drivers.host.amplifier import Amplifier
from drivers.opening import Lines
from registry.limits import GuardLimits

SESSION = 9


@asynccontextmanager
async def playing(url: str, tone: Tone, *, watchdog: float) -> AsyncIterator[Amplifier]:
    """Open, arm and play without a ramp; watchdog [s]: of which it falls silent after this."""
    lines = Lines()
    try:
        amplifier = await lines.amplifier(url, GuardLimits(40, 500, 1), name=url)
        await amplifier.open()
        await amplifier.arm(SESSION, watchdog)
        await amplifier.stage(1, [Layer(0, (tone,), ramp=0.0)], now=True)
        yield amplifier
    finally:
        await lines.close()
