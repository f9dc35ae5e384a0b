"""How far long work is: the one way in which it is shown."""

from collections.abc import Callable
from typing import TypeAlias

Progress: TypeAlias = Callable[[int, int], None]
"""Is called with what is done, of all: tasks, places, stages."""


def unseen(done: int, total: int) -> None:
    """Progress that is not shown."""
