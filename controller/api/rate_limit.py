"""Token bucket: a rate, and as many at once as in a second."""

from collections.abc import Callable


class RateLimiter:
    """Allows `per_second` actions per second, and as many in a burst; clock [s]."""

    def __init__(self, per_second: float, *, clock: Callable[[], float]) -> None:
        self._per_second = per_second
        self._clock = clock
        self._left = per_second
        self._counted_at = clock()

    def take(self) -> bool:
        """Whether another action is allowed now; counts it."""
        now = self._clock()
        self._left = min(self._per_second, self._left + self._per_second * (now - self._counted_at))
        self._counted_at = now
        if self._left < 1:
            return False
        self._left -= 1
        return True
