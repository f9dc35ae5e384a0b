"""Delays of the witness itself, in which what passed was seen late."""

from collections import deque

_KEPT = 64


class Delays:
    """Delays of this program by the time [s] of their end; deadlines are extended by them."""

    def __init__(self) -> None:
        self._known: deque[tuple[float, float]] = deque(maxlen=_KEPT)

    def note(self, until: float, duration: float) -> None:
        """Note that nothing was seen for a duration [s] until a time [s]."""
        self._known.append((until, duration))

    def since(self, time: float) -> float:
        """Sum of the delays [s] that ended after a time [s]."""
        return sum(duration for until, duration in self._known if until >= time)
