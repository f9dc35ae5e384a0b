"""Feeding an amplifier's watchdog while a script or command waits."""

import asyncio

from drivers import clock
from drivers.amplifier import Amplifier
from drivers.errors import CommandRefused
from drivers.operation.watchdog import HEARTBEAT
from drivers.protocol.messages import AmplifierState


async def keep_alive(amplifier: Amplifier, duration: float, *, interval: float = HEARTBEAT) -> None:
    """Send a heartbeat every `interval` [s] for a time [s].

    Raises CommandRefused if the amplifier leaves OPERATION_ENABLED meanwhile.
    """
    end = clock.now() + duration
    while (left := end - clock.now()) > 0:
        await asyncio.sleep(min(interval, left))
        status = await amplifier.heartbeat()
        if status.state is not AmplifierState.OPERATION_ENABLED:
            raise CommandRefused(
                f"the amplifier stopped by itself: state {status.state.name}, fault "
                f"{status.fault.name}; once the cause is gone, clear it and arm it again"
            )
