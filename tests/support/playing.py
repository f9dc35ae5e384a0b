"""An amplifier behind a URL that is armed and plays one tone."""

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from drivers.amplifier import Amplifier
from drivers.command import CommandSet, DriveCommand
from drivers.guard import Guard, GuardLimits
from drivers.registry import open_backend


@asynccontextmanager
async def playing(url: str, command: DriveCommand, *, watchdog: float) -> AsyncIterator[Amplifier]:
    """Open, arm and play without a ramp; watchdog [s]. Replies may take 5 s on a busy machine."""
    amplifier = Amplifier(open_backend(url), reply_timeout=5.0)
    await amplifier.open()
    try:
        await amplifier.arm(watchdog)
        guard = Guard(GuardLimits(40, 500, 1), amplifier.capabilities)
        await amplifier.apply(guard.check(CommandSet(1, (command,), ramp=0.0, valid_for=0.0)))
        yield amplifier
    finally:
        await amplifier.close()
