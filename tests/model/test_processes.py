"""Work shared out among processes, where these do not live."""

import os

import pytest

from model.errors import InputError
from model.processes import on_processes


def die(shared: int, task: int) -> None:
    """As a process does that the system ends for want of memory."""
    os._exit(shared + task)


def test_processes_that_die_again_and_again_are_given_up() -> None:
    """After four pools of them, in a sentence that names the likely cause and what to try."""
    with pytest.raises(InputError, match="died 4 times"):
        list(on_processes(1, die, 1, {0: 8}))
