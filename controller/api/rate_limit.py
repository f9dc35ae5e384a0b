"""Token buckets: of actions at a rate, and of processor time at a share."""

from collections.abc import Callable


class RateLimiter:
    """Allows `per_second` actions per second, and a burst, as many unless given; clock [s]."""

    def __init__(
        self, per_second: float, *, burst: float | None = None, clock: Callable[[], float]
    ) -> None:
        self._per_second = per_second
        self._burst = per_second if burst is None else burst
        self._clock = clock
        self._left = self._burst
        self._counted_at = clock()

    def take(self) -> bool:
        """Whether another action is allowed now; counts it."""
        if self._saved() < 1:
            return False
        self._left -= 1
        return True

    @property
    def is_unused(self) -> bool:
        """Whether a whole burst is allowed now."""
        return self._saved() >= self._burst

    def _saved(self) -> float:
        now = self._clock()
        saved = self._left + self._per_second * (now - self._counted_at)
        self._left, self._counted_at = min(self._burst, saved), now
        return self._left


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
