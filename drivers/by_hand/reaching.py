"""The amplifier at a URL, for one action; and what its wire carries."""

import asyncio
import math
import random
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

from drivers import clock
from drivers.host.amplifier import Amplifier
from drivers.host.limits import FREQUENCY_FLOOR
from drivers.host.timing import TAKEN_WORDS, set_words, shortest_watchdog
from drivers.opening import Lines
from drivers.protocol.table import QUANTITIES
from registry.limits import GuardLimits

CEILINGS = GuardLimits(FREQUENCY_FLOOR, QUANTITIES["frequency"].high, 1.0)
"""Limits where no rig states any."""
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
    """Open the line of an amplifier and identify it; what it plays goes on."""
    async with reached(url, serial_number=serial_number) as amplifier:
        await amplifier.identify()
        yield amplifier


async def keep_alive(amplifier: Amplifier, duration: float, interval: float) -> None:
    """Feed the watchdog for a time, at an interval [s]."""
    end = clock.now() + duration
    while (left := end - clock.now()) > 0:
        await asyncio.sleep(min(interval, left))
        await amplifier.ping()


def random_session() -> int:
    """Draw the number of a session, so that it is not taken for another host's."""
    return random.randint(_SESSION.minimum, _SESSION.maximum)  # noqa: S311  no secret


def round_trip(amplifier: Amplifier) -> float:
    """Return how long a set of all channels and its reply take on the wire [s]; 0 if unknown."""
    words = set_words(amplifier.capabilities["channels"])
    return amplifier.line.wire.exchange_time(words, TAKEN_WORDS)


def wire_rows(amplifier: Amplifier) -> dict[str, Any]:
    """Return limits by the wire's speed; empty where that is unknown."""
    takes = round_trip(amplifier)
    if not takes:
        return {}
    return {
        "wire_round_trip_s": round(takes, 6),
        "sets_per_second_max": math.floor(1 / takes),
        "watchdog_shortest_s": round(shortest_watchdog(takes), 6),
    }
