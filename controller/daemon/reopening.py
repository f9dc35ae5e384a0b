"""Opening the amplifiers again after a loss, as often as it takes."""

import asyncio
from collections.abc import Callable, Coroutine
from typing import Any

from controller.loop.loop import Controller
from drivers import clock
from drivers.errors import DriverError
from drivers.link.link import ASSUME_ENERGISED
from drivers.operation.pauses import pauses
from model.errors import InputError

TICK = 0.05  # s; how often it is told meanwhile that we are alive


def what_is_wrong(error: Exception) -> str:
    """What an error says; what to assume of a lost amplifier the daemon's state tells."""
    return str(error).removesuffix(ASSUME_ENERGISED)


async def reopen(
    controller: Controller,
    *,
    is_wanted: Callable[[], bool],
    told: Callable[[str, str], None],
    alive: Callable[[], None],
) -> bool:
    """Open a controller and disarm all it drives, with growing pauses between the attempts.

    is_wanted: whether to go on; False is returned where it ends that way. told: of each attempt
    that fails (retry), and of the one that does not (reopened), with a message. alive: called every
    50 ms meanwhile.
    """
    await _attended(controller.close(), alive)  # whoever closes it still would close it again
    for pause in pauses():
        if not is_wanted():
            return False
        try:
            await _attended(controller.open(), alive)
            await controller.disarm()  # one was lost for less than its watchdog, perhaps
        except (DriverError, InputError) as error:
            told("retry", what_is_wrong(error))
            await controller.close()
        else:
            told("reopened", "every amplifier answers again, and is disarmed")
            return True
        end = clock.now() + pause
        while (left := end - clock.now()) > 0 and is_wanted():
            alive()
            await asyncio.sleep(min(left, TICK))
    raise AssertionError("pauses have no end")


async def _attended(work: Coroutine[Any, Any, None], alive: Callable[[], None]) -> None:
    """Wait for something that may take seconds, such as a connection; the loop runs on."""
    task = asyncio.create_task(work)
    try:
        while not (await asyncio.wait({task}, timeout=TICK))[0]:
            alive()
    except asyncio.CancelledError:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)
        raise
    task.result()
