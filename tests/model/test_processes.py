"""Worker processes that die, and those whose program does."""

import os
import signal
import subprocess
import sys

import pytest

from model.errors import InputError
from model.processes import on_processes


def die(shared: int, task: int) -> None:
    """End the process at once, as the system does when memory is short."""
    os._exit(shared + task)


def test_a_process_that_dies_is_an_error() -> None:
    """With a remedy."""
    with pytest.raises(InputError, match=r"died.*--workers"):
        list(on_processes(2, die, 1, {0: 8}))


def die_with_the_program(shared: int, task: int) -> None:
    """Kill the program, and go on."""
    os.kill(os.getppid(), signal.SIGKILL)


def test_workers_end_with_a_program_that_is_killed() -> None:
    """Its output ends: a worker that waits for tasks would hold it open."""
    program = (
        "from model.processes import on_processes; from test_processes import *\n"
        "if __name__ == '__main__': list(on_processes(2, die_with_the_program, 1, {0: 1}))"
    )
    environment = {**os.environ, "PYTHONPATH": os.path.dirname(__file__)}  # noqa: PTH120
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, env=environment, timeout=60
    )
    assert done.returncode == -signal.SIGKILL
