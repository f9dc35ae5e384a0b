"""Connect to the amplifier at a URL, and keep it alive."""

import asyncio
import random
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from drivers.host.amplifier import Amplifier
from drivers.host.rounding import FREQUENCY_FLOOR
from drivers.opening import Lines
from drivers.protocol.definition import QUANTITIES
from registry import threads
from registry.limits import GuardLimits

CEILINGS = GuardLimits(FREQUENCY_FLOOR, QUANTITIES["frequency"].high, 1.0)
"""Limits without a rig."""
_SESSION = QUANTITIES["session"]


@asynccontextmanager
async def reached(
    url: str,
    *,
    limits: GuardLimits = CEILINGS,
    serial_number: str | None = None,
    is_output: bool | None = None,
) -> AsyncIterator[Amplifier]:
    """Open the line of an amplifier while the context lasts; nothing is sent."""
    lines = Lines()
    try:
        yield await lines.amplifier(
            url, limits, name=url, serial_number=serial_number, is_output=is_output
        )
    finally:
        await lines.close()


@asynccontextmanager
async def identified(url: str, *, serial_number: str | None = None) -> AsyncIterator[Amplifier]:
    """Open the line of an amplifier and identify it; its playback continues."""
    async with reached(url, serial_number=serial_number) as amplifier:
        await amplifier.identify()
        yield amplifier


async def keep_alive(amplifier: Amplifier, duration: float, interval: float) -> None:
    """Feed the watchdog for a time, at an interval [s]."""
    end = threads.now() + duration
    remaining = duration
    while remaining > 0:
        await asyncio.sleep(min(interval, remaining))
        await amplifier.ping()
        remaining = end - threads.now()


def random_session() -> int:
    """Draw the number of a session, so that it is not taken for another host's."""
    return random.randint(_SESSION.minimum, _SESSION.maximum)  # noqa: S311  no secret
