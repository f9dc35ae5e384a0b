"""Opening an amplifier again whose link was lost."""

import asyncio

from drivers import clock
from drivers.amplifier import Amplifier
from drivers.errors import DriverError

_REOPENING = 2.0  # s; an adapter that was reset has its port again by then, and its old one closed
_PAUSE = 0.1  # s; between tries


async def reopened(amplifier: Amplifier) -> str:
    """Open an amplifier again if it was lost; return why it cannot be opened, or nothing."""
    end = clock.now() + _REOPENING
    while amplifier.is_lost:
        try:
            await amplifier.close()
            await amplifier.open()
        except DriverError as error:
            if clock.now() >= end:
                return str(error)
            await asyncio.sleep(_PAUSE)
    return ""
