"""Feeding an amplifier's watchdog while a script or command waits."""

import asyncio

from drivers import clock
from drivers.operation.checked_amplifier import CheckedAmplifier
from drivers.operation.watchdog import HEARTBEAT


async def keep_alive(
    amplifier: CheckedAmplifier, duration: float, *, interval: float = HEARTBEAT
) -> None:
    """Send a heartbeat every `interval` [s] for a time [s].

    Raises CommandRefused if the amplifier leaves OPERATION_ENABLED meanwhile, or its
    replies contradict requests.
    """
    end = clock.now() + duration
    while (left := end - clock.now()) > 0:
        await asyncio.sleep(min(interval, left))
        await amplifier.heartbeat()
