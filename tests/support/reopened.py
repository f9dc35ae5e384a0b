"""A lost amplifier, opened again as the daemon does it: disarmed, and armed by nobody."""

import asyncio

from drivers.amplifier import Amplifier
from drivers.errors import LinkError
from drivers.protocol.messages import AmplifierState


async def reconnect(amplifier: Amplifier, *, tries: int = 100, pause: float = 0.01) -> None:
    """Open it, at the latest with the last try; what keeps that one from it is raised.

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
