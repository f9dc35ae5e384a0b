"""The gateway as a child process of the daemon that must not disturb its loop.

It is an ordinary API client. One that exits is restarted after a growing pause; it ends with the
daemon, even if that is killed.
"""

import asyncio
import contextlib
import logging
import os
import secrets
import sys
from pathlib import Path

from controller.child import child_command, ended
from drivers import clock
from drivers.pauses import Backoff
from model.errors import InputError

_MAX_PAUSE = 30.0  # s
_TERMINATE_TIMEOUT = 0.3  # s
_GATEWAY = ("controller.cli", "gateway")

_logger = logging.getLogger(__name__)


def gateway_options(address: str, socket: Path) -> list[str]:
    """Return options of a gateway that serves the page at HOST:PORT, with a new token.

    Where the gateway would print its token into a log, the token is in a file that only its owner
    may read. Raises InputError if that cannot be written.
    """
    options = ["--socket", str(socket), "--listen", address]
    if sys.stdout.isatty():
        return options
    file = socket.with_name("dashboard-token")
    try:
        file.unlink(missing_ok=True)
        with open(file, "x", opener=lambda name, flags: os.open(name, flags, 0o600)) as stream:
            stream.write(f"{secrets.token_urlsafe(32)}\n")
    except OSError as error:
        raise InputError(f"{file}: cannot write the dashboard's token: {error.strerror}") from error
    _logger.info("dashboard: token in %s", file)
    return [*options, "--token-file", str(file)]


async def keep_gateway(options: list[str]) -> None:
    """Keep a gateway running until cancelled; then it is terminated, or killed if it is late."""
    backoff = Backoff(first=1.0, maximum=_MAX_PAUSE)
    while True:
        started_at = clock.now()
        try:
            process = await asyncio.create_subprocess_exec(
                *child_command(*_GATEWAY, *options),
                stdin=asyncio.subprocess.DEVNULL,
                start_new_session=True,  # Ctrl-C is handled by the daemon
            )
        except OSError as error:
            _logger.warning("gateway: start failed: %s", error)
        else:
            try:
                _logger.warning("gateway: exited with status %d", await process.wait())
            except asyncio.CancelledError:
                with contextlib.suppress(ProcessLookupError):
                    process.terminate()
                await ended(process, _TERMINATE_TIMEOUT)
                raise
        pause = backoff.pause(ran_for=clock.now() - started_at)
        _logger.info("gateway: restarting in %g s", pause)
        await asyncio.sleep(pause)
