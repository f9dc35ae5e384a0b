"""How long to wait before something that failed is tried again."""

from collections.abc import Iterator

FIRST_PAUSE = 0.1  # s; a cable that was only knocked is back by then
LONGEST_PAUSE = 5.0  # s; nobody waits longer for an adapter that was plugged in again


def pauses(first: float = FIRST_PAUSE, longest: float = LONGEST_PAUSE) -> Iterator[float]:
    """Pauses [s] between attempts, each twice the one before."""
    pause = first
    while True:
        yield pause
        pause = min(2 * pause, longest)
