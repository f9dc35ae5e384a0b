"""Reopening of a lost amplifier as by the daemon: disarmed."""

import asyncio

from drivers.amplifier import Amplifier
from drivers.errors import LinkError
from drivers.protocol.messages import AmplifierState


async def reconnect(amplifier: Amplifier, *, tries: int = 100, pause: float = 0.01) -> None:
    """Open it within a number of tries; the last failure is raised.

    pause [s]: between tries.
    """
    for left in reversed(range(tries)):
        try:
            await amplifier.close()
            await amplifier.open()
            if (await amplifier.status()).state is AmplifierState.OPERATION_ENABLED:
                await amplifier.disarm()  # it was lost for less than its watchdog
        except LinkError:
            if not left:
                raise
            await asyncio.sleep(pause)
        else:
            return
