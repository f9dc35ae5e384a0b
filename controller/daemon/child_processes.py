"""Child processes of the daemon that must not disturb its loop: the gateway.

Each is an ordinary API client. A child that exits is restarted after a growing pause; all end with
the daemon, even if that is killed.
"""

import asyncio
import contextlib
import logging
import os
import sys

from drivers import clock
from drivers.pauses import Backoff

_MAX_PAUSE = 30.0  # s
_TERMINATE_TIMEOUT = 0.3  # s

_logger = logging.getLogger(__name__)


class ChildProcesses:
    """Runs Python modules as processes and restarts them when they exit."""

    def __init__(self) -> None:
        self._tasks: list[asyncio.Task[None]] = []

    def start(self, module: str, *arguments: str) -> None:
        """Keep a module running until `close`."""
        self._tasks.append(asyncio.create_task(self._keep_running(module, arguments), name=module))

    async def close(self) -> None:
        """Terminate all children; kill those that do not exit in time."""
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    async def _keep_running(self, module: str, arguments: tuple[str, ...]) -> None:
        backoff = Backoff(first=1.0, maximum=_MAX_PAUSE)
        while True:
            started_at = clock.now()
            try:
                process = await asyncio.create_subprocess_exec(
                    # -P: do not import a folder named controller in the working directory
                    *(sys.executable, "-P", "-m", "controller.daemon.child_main"),
                    *(str(os.getpid()), module, *arguments),
                    stdin=asyncio.subprocess.DEVNULL,
                    start_new_session=True,  # Ctrl-C is handled by the daemon
                )
            except OSError as error:
                _logger.warning("%s: start failed: %s", module, error)
            else:
                _logger.warning("%s: exited with status %d", module, await self._wait(process))
            pause = backoff.pause(ran_for=clock.now() - started_at)
            _logger.info("%s: restarting in %g s", module, pause)
            await asyncio.sleep(pause)

    async def _wait(self, process: asyncio.subprocess.Process) -> int:
        """Wait for a process to exit; terminate it when cancelled."""
        try:
            return await process.wait()
        except asyncio.CancelledError:
            with contextlib.suppress(ProcessLookupError):
                process.terminate()
            try:
                async with asyncio.timeout(_TERMINATE_TIMEOUT):
                    await process.wait()
            except TimeoutError:
                with contextlib.suppress(ProcessLookupError):
                    process.kill()
                await process.wait()
            raise
