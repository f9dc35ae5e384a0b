"""How far long work is: the one way in which it is shown."""

from collections.abc import Callable
from typing import TypeAlias

from model.arguments import shown
from model.errors import InputError

Progress: TypeAlias = Callable[[int, int], None]
"""Is called with what is done, of all: tasks, places, stages."""


def unseen(done: int, total: int) -> None:
    """Progress that is not shown."""


def check_progress(given: object) -> None:
    """Raise InputError for what cannot be called."""
    if not callable(given):
        raise InputError(f"progress must be a function of done and total, got {shown(given)}")
