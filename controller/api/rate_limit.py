"""Token buckets: of actions at a rate, and of processor time at a share."""

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


class TimeBudget:
    """Processor time: a share of the time that passes, saved up to a burst [s]; clock [s].

    It can be overdrawn by as much as a burst.
    """

    def __init__(self, share: float, burst: float, *, clock: Callable[[], float]) -> None:
        self._share = share
        self._burst = burst
        self._clock = clock
        self._left = burst
        self._counted_at = clock()

    def spend(self, duration: float) -> None:
        """Subtract a duration [s]."""
        self._left = max(self._saved() - duration, -self._burst)

    def pause(self) -> float:
        """Time [s] until it is not overdrawn; 0 if it is not, or by less than a microsecond."""
        self._left = self._saved()
        return -self._left / self._share if self._left < -1e-6 else 0.0

    def _saved(self) -> float:
        now = self._clock()
        since, self._counted_at = now - self._counted_at, now
        return min(self._burst, self._left + self._share * since)
