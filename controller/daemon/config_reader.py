"""Reads a daemon's configuration in a process of its own, beside a running control loop.

A thread that parses for a second holds the interpreter's lock up to 5 ms at a time, and for as long
as another program has its processor: the loop and its heartbeats would wait for it.

    python -m controller.daemon.config_reader FILE

writes the configuration, or the text of its problems, in Python's pickle format.
"""

import contextlib
import os
import pickle
import subprocess
import sys
from pathlib import Path

from controller.child import child_command
from controller.daemon.config import DaemonConfig, load_daemon_config
from model.errors import InputError

_TIMEOUT = 60.0  # s; a plug-in or a file on a lost network folder may hang
_NICE = 10  # above that of the daemon, whose loop comes first


def read_in_child(file: Path) -> DaemonConfig:
    """Read a configuration in a child process; blocks, InputError with all problems.

    Raises OSError if the process cannot be started or fails.
    """
    try:
        done = subprocess.run(  # noqa: S603  our own module
            child_command("controller.daemon.config_reader", str(file)),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            start_new_session=True,  # Ctrl-C is handled by the daemon
            timeout=_TIMEOUT,
            check=False,
        )
    except subprocess.TimeoutExpired as error:
        raise TimeoutError(f"reading {file} took longer than {_TIMEOUT:g} s") from error
    if done.returncode != 0:
        raise OSError(f"reading {file} failed with status {done.returncode}")
    read = pickle.loads(done.stdout)  # noqa: S301  of our own process
    if isinstance(read, DaemonConfig):
        return read
    raise InputError(str(read))


def _main() -> None:
    with contextlib.suppress(OSError):
        os.nice(_NICE)
    output = sys.stdout.buffer
    sys.stdout = sys.stderr  # for what a plugin prints
    read: DaemonConfig | str
    try:
        read = load_daemon_config(Path(sys.argv[1]))
    except InputError as error:
        read = str(error)
    pickle.dump(read, output)
    output.flush()


if __name__ == "__main__":
    _main()
