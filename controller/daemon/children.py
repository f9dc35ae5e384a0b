"""Child processes that keep work out of the daemon's loop: the gateway and a file reader.

The gateway is an ordinary API client. It is restarted after a growing pause when it exits, and
ends with the daemon, even if that is killed.

`python -m controller.daemon.children FILE` reads a configuration, renders its content for the given
frequencies, and writes the configuration, or the text of its problems, as a pickle. A parsing
thread would hold the interpreter lock for 5 ms at a time, and longer if another program has its
processor; the loop and its heartbeats would have to wait.
"""

import asyncio
import contextlib
import logging
import os
import pickle
import secrets
import subprocess
import sys
import tempfile
from pathlib import Path

from controller.daemon.config import DaemonConfig, load_daemon_config
from controller.process.child import child_command, ended
from model.arrays import FloatArray
from model.errors import InputError
from registry import threads
from registry.retries import Backoff

_MAX_PAUSE = 30.0  # s
_TERMINATE_TIMEOUT = 0.3  # s
_GATEWAY = ("controller.cli", "gateway")
_READ_TIMEOUT = 60.0  # s; a plug-in or a lost network folder can hang
_NICE = 10  # added to the daemon's niceness, so that its loop has priority

_logger = logging.getLogger(__name__)


def gateway_options(address: str, socket: Path, *, shows_token: bool = False) -> list[str]:
    """Return options of a gateway that serves the page at HOST:PORT, with a new token.

    If the gateway would print its token into a log, the token goes to a file that only its owner
    can read, unless shows_token is true. Raises InputError if the file cannot be written.
    """
    options = ["--socket", str(socket), "--listen", address]
    if shows_token or sys.stdout.isatty():
        return options
    file = socket.with_name("dashboard-token")
    try:
        file.unlink(missing_ok=True)
        with open(file, "x", opener=lambda name, flags: os.open(name, flags, 0o600)) as stream:
            stream.write(f"{secrets.token_urlsafe(32)}\n")
    except OSError as error:
        raise InputError(f"{file}: cannot write the dashboard's token: {error.strerror}") from error
    return [*options, "--token-file", str(file)]


async def keep_gateway(options: list[str]) -> None:
    """Keep a gateway running until cancelled; then it is terminated, or killed if it is late."""
    backoff = Backoff(first=1.0, maximum=_MAX_PAUSE)
    while True:
        started_at = threads.now()
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
        pause = backoff.pause(ran_for=threads.now() - started_at)
        _logger.info("gateway: restarting in %g s", pause)
        await asyncio.sleep(pause)


def read_in_child(file: Path, frequencies: FloatArray) -> DaemonConfig:
    """Read a configuration in a child process, for the frequencies of a table [Hz]; blocks.

    Raises InputError with all problems, also for a plug-in that was installed or changed after this
    process started, and OSError if the child cannot be started or fails.
    """
    with tempfile.TemporaryFile() as output:
        try:
            process = subprocess.run(  # noqa: S603  our own module
                child_command("controller.daemon.children", str(file)),
                input=pickle.dumps(frequencies),
                stdout=output,
                timeout=_READ_TIMEOUT,
                start_new_session=True,  # Ctrl-C is handled by the daemon
                check=False,
            )
        except subprocess.TimeoutExpired as error:
            raise TimeoutError(f"reading {file} took longer than {_READ_TIMEOUT:g} s") from error
        if process.returncode != 0:
            raise OSError(f"reading {file} failed with status {process.returncode}")
        output.seek(0)
        try:
            # Each read of the file lets other threads run; the bytes of many layouts, hundreds of
            # megabytes, would hold the interpreter for too long.
            config = pickle.load(output)  # noqa: S301  of our own process
        except (ImportError, AttributeError, TypeError) as error:
            raise InputError(
                f"{file} uses a plug-in that was installed or changed after the daemon started "
                f"({error}); restart the daemon"
            ) from error
    if isinstance(config, DaemonConfig):
        return config
    raise InputError(str(config))


def _main() -> None:
    with contextlib.suppress(OSError):
        os.nice(_NICE)
    output = sys.stdout.buffer
    sys.stdout = sys.stderr  # for output of plug-ins
    result: DaemonConfig | str
    try:
        frequencies = pickle.load(sys.stdin.buffer)  # noqa: S301  of the daemon
        config = load_daemon_config(Path(sys.argv[1]))
        result = config.for_table(frequencies)
    except InputError as error:
        result = str(error)
    pickle.dump(result, output)
    output.flush()


if __name__ == "__main__":
    _main()
