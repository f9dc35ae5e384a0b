"""After a loss: how long an amplifier may still play, and when to look for it again."""

from collections.abc import Iterator

FIRST_PAUSE = 0.1  # s; a cable that was only knocked is back by then
LONGEST_PAUSE = 5.0  # s; nobody waits longer for an adapter that was plugged in again
_MARGIN = 0.1  # s; beyond the watchdog, for the clocks and the last ramp


def pauses(first: float = FIRST_PAUSE, longest: float = LONGEST_PAUSE) -> Iterator[float]:
    """Pauses [s] between attempts, each twice the one before."""
    pause = first
    while True:
        yield pause
        pause = min(2 * pause, longest)


def assume_energised(lost_at: float, now: float, *, watchdog: float) -> bool:
    """Whether an amplifier that was lost at a time [s] may still be playing now [s]."""
    return now - lost_at < watchdog + _MARGIN
