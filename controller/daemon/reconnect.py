"""Reopen the amplifiers after a loss, with growing pauses between attempts."""

import asyncio
from collections.abc import Callable, Coroutine
from typing import Any, Literal

from controller.loop.loop import Controller
from drivers import clock
from drivers.errors import DriverError
from drivers.pauses import pauses
from model.errors import InputError

ALIVE_INTERVAL = 0.05  # s; between calls of `alive` while waiting

LinkChange = Literal["degraded", "restored", "lost", "retry", "reopened"]


async def reconnect(
    controller: Controller,
    *,
    should_continue: Callable[[], bool],
    report: Callable[[LinkChange, str], None],
    alive: Callable[[], None],
) -> bool:
    """Reopen a controller and disarm its amplifiers; return False if cancelled.

    report: called with "retry" after each failed attempt and "reopened" after the successful one,
    and a message. alive: called every 50 ms meanwhile.
    """
    await wait_alive(controller.close(), alive)  # a pending close would close it again
    for pause in pauses():
        if not should_continue():
            return False
        try:
            await wait_alive(controller.open(), alive)
            await controller.disarm()  # a short loss may not have expired the watchdog
        except (DriverError, InputError) as error:
            report("retry", str(error))
            await controller.close()
        else:
            report("reopened", "all amplifiers reply again and are disarmed")
            return True
        end = clock.now() + pause
        while (left := end - clock.now()) > 0 and should_continue():
            alive()
            await asyncio.sleep(min(left, ALIVE_INTERVAL))
    raise AssertionError("pauses() must not end")


async def wait_alive(work: Coroutine[Any, Any, None], alive: Callable[[], None]) -> None:
    """Await work that may take seconds, such as a connection, calling `alive` meanwhile."""
    task = asyncio.create_task(work)
    try:
        while not (await asyncio.wait({task}, timeout=ALIVE_INTERVAL))[0]:
            alive()
    except asyncio.CancelledError:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)
        raise
    task.result()
