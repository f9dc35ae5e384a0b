"""Commands that are cut short: interrupted while they compute, or writing to a full disk.

Each interrupted command is a process, forked off one that has loaded what all of them need: loading
takes the most time.
"""

import contextlib
import json
import os
import resource
import shlex
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping
from importlib import import_module
from pathlib import Path
from unittest.mock import patch


@contextlib.contextmanager
def full_disk(*, at: int = 1024) -> Iterator[None]:
    """Limit the size [bytes] of every file that this process writes: beyond it, OSError is raised.

    Python writes no bytecode meanwhile: it would not notice that a file was cut off, and later
    imports of the module would fail.
    """
    former_limit = resource.getrlimit(resource.RLIMIT_FSIZE)
    without_bytecode = sys.dont_write_bytecode
    sys.dont_write_bytecode = True
    resource.setrlimit(resource.RLIMIT_FSIZE, (at, former_limit[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, former_limit)
        sys.dont_write_bytecode = without_bytecode


def interrupted(commands: Mapping[str, str], folder: Path) -> dict[str, tuple[int, str]]:
    """Exit status of each command, and what it says on standard error; run one after the other.

    commands: with the function, by its full name, in which Ctrl-C comes.
    """
    done = subprocess.run(
        [sys.executable, __file__],
        input=json.dumps(commands),
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    answers: dict[str, tuple[int, str]] = json.loads(done.stdout)
    return answers


def _interrupted(command: str, inside: str) -> tuple[int, str]:
    reading, writing = os.pipe()
    with tempfile.TemporaryFile() as errors, Path(os.devnull).open("wb") as out:
        pid = os.fork()
        if not pid:
            os.close(reading)
            os.dup2(errors.fileno(), 2)
            os.dup2(out.fileno(), 1)
            os._exit(_waiting(command, inside, writing))
        os.close(writing)
        is_there = os.read(reading, 1)
        os.close(reading)
        if is_there:
            os.kill(pid, signal.SIGINT)
        _, status = os.waitpid(pid, 0)
        errors.seek(0)
        return os.waitstatus_to_exitcode(status), errors.read().decode()


def _waiting(command: str, inside: str, writing: int) -> int:
    """Run a command that comes to a halt in a function, and tells that it is there."""

    def wait(*args: object, **kwargs: object) -> None:
        os.write(writing, b".")
        while True:  # a signal just before signal.pause() would not end that
            time.sleep(0.1)

    sys.argv = ["era", *shlex.split(command)]
    with patch(inside, wait):
        status = main()
    sys.stderr.flush()
    return status


if __name__ == "__main__":
    from era_haptics.command import main

    asked = json.loads(sys.stdin.read())
    for module in {at.rpartition(".")[0] for at in asked.values()}:
        import_module(module)
    json.dump({command: _interrupted(command, at) for command, at in asked.items()}, sys.stdout)
