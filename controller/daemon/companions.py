"""Processes that belong to the daemon but must not disturb it: the gateway, the metrics.

Each is a client of the API like any other. One that ends by itself is started again, after a pause
that grows; all end with the daemon, also when that is killed.
"""

import asyncio
import contextlib
import logging
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass

from drivers.operation.pauses import pauses

_LONGEST_PAUSE = 30.0  # s
_END_TIMEOUT = 0.3  # s

_logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Companion:
    """A Python module that is run as a process, with its arguments."""

    module: str
    arguments: Sequence[str]


class Companions:
    """Starts companions and keeps them running."""

    def __init__(self) -> None:
        self._tasks: list[asyncio.Task[None]] = []

    def start(self, companion: Companion) -> None:
        """Run a companion until `close`."""
        self._tasks.append(asyncio.create_task(self._keep(companion), name=companion.module))

    async def close(self) -> None:
        """End all, with force if need be."""
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    async def _keep(self, companion: Companion) -> None:
        for pause in pauses(first=1.0, longest=_LONGEST_PAUSE):
            try:
                process = await asyncio.create_subprocess_exec(
                    # -P: a folder named controller where the user stands must not be taken for ours
                    *(sys.executable, "-P", "-m", "controller.daemon.companion_main"),
                    *(str(os.getpid()), companion.module, *companion.arguments),
                    stdin=asyncio.subprocess.DEVNULL,
                    start_new_session=True,  # Ctrl-C is the daemon's to deal with
                )
            except OSError as error:
                _logger.warning("%s cannot be started: %s", companion.module, error)
            else:
                status = await self._end_of(process)
                _logger.warning(
                    "%s has ended with status %d; it is started again in %g s",
                    *(companion.module, status, pause),
                )
            await asyncio.sleep(pause)

    async def _end_of(self, process: asyncio.subprocess.Process) -> int:
        """Wait for a process; where we are cancelled, end it."""
        try:
            return await process.wait()
        except asyncio.CancelledError:
            with contextlib.suppress(ProcessLookupError):
                process.terminate()
            try:
                async with asyncio.timeout(_END_TIMEOUT):
                    await process.wait()
            except TimeoutError:
                with contextlib.suppress(ProcessLookupError):
                    process.kill()
                await process.wait()
            raise
