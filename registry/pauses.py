"""Pauses before retries."""

from collections.abc import Iterator

FIRST_PAUSE = 0.1  # s; a loose contact recovers within it
MAX_PAUSE = 5.0  # s; the longest wait after an adapter was plugged in again
GOOD_TIME = 60.0
"""Time [s] of working after which pauses start anew."""


def pauses(first: float = FIRST_PAUSE, maximum: float = MAX_PAUSE) -> Iterator[float]:
    """Yield pauses [s] between attempts, each twice the previous one."""
    pause = first
    while True:
        yield pause
        pause = min(2 * pause, maximum)


class Backoff:
    """Pauses [s] before restarts: each twice the previous one, the first again after a good run."""

    def __init__(self, first: float, maximum: float) -> None:
        self._bounds = first, maximum
        self._pauses = pauses(*self._bounds)

    def pause(self, *, ran_for: float) -> float:
        """Return the pause before a restart of what ran for a time [s]."""
        if ran_for >= GOOD_TIME:
            self._pauses = pauses(*self._bounds)
        return next(self._pauses)
