"""Pauses before retries."""

from collections.abc import Iterator

FIRST_PAUSE = 0.1  # s; a loose contact has recovered by then
MAX_PAUSE = 5.0  # s; the longest wait after an adapter was plugged in again


def pauses(first: float = FIRST_PAUSE, maximum: float = MAX_PAUSE) -> Iterator[float]:
    """Yield pauses [s] between attempts, each twice the previous one."""
    pause = first
    while True:
        yield pause
        pause = min(2 * pause, maximum)
