"""How often something may be done: so many times a second, and as many at once."""

from collections.abc import Callable


class RateLimiter:
    """A bucket that holds `per_second` and fills at that rate; clock [s]."""

    def __init__(self, per_second: float, *, clock: Callable[[], float]) -> None:
        self._per_second = per_second
        self._clock = clock
        self._left = per_second
        self._counted_at = clock()

    def take(self) -> bool:
        """Whether it may be done once more now; counts it."""
        now = self._clock()
        self._left = min(self._per_second, self._left + self._per_second * (now - self._counted_at))
        self._counted_at = now
        if self._left < 1:
            return False
        self._left -= 1
        return True
