"""Pauses between retries, and before restarts of a program: they increase."""

from collections.abc import Iterator

FIRST_PAUSE = 0.1
"""First pause between retries [s]; a loose contact recovers in this time."""

MAX_PAUSE = 5.0
"""Maximum pause between retries [s]: the longest wait after an adapter was plugged in again."""

GOOD_TIME = 60.0
"""Time of successful operation [s] after which pauses are reset."""


def pauses(first: float = FIRST_PAUSE, maximum: float = MAX_PAUSE) -> Iterator[float]:
    """Yield pauses between attempts [s], each twice the previous pause, up to a maximum."""
    pause = first
    while True:
        yield pause
        pause = min(2 * pause, maximum)


class Backoff:
    """Pauses before restarts of a program: each twice the previous pause, reset after a good run.

    first, maximum: the shortest and the longest pause [s].
    """

    def __init__(self, first: float, maximum: float) -> None:
        self._bounds = first, maximum
        self._pauses = pauses(*self._bounds)

    def pause(self, *, ran_for: float) -> float:
        """Return the pause [s] before the restart of a program that ran for a time [s]."""
        if ran_for >= GOOD_TIME:
            self._pauses = pauses(*self._bounds)
        return next(self._pauses)
