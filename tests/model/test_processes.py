"""Worker processes that die."""

import os

import pytest

from model.errors import InputError
from model.processes import on_processes


def die(shared: int, task: int) -> None:
    """End the process at once, as the system does when memory is short."""
    os._exit(shared + task)


def test_on_processes_gives_up_after_repeated_deaths() -> None:
    """After four pools, with a remedy."""
    with pytest.raises(InputError, match=r"died 4 times.*--workers"):
        list(on_processes(2, die, 1, {0: 8}))
