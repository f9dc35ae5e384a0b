"""A token bucket: of actions at a rate, or of processor time at a share."""

from collections.abc import Callable, Hashable
from functools import partial

_MAX_RATES = 256  # above which those that were not used lately are forgotten


class RateLimiter:
    """Allows `per_second` actions, or seconds, per second, and a burst; clock [s].

    The burst is as many as a second allows, unless given.
    """

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

    def spend(self, amount: float) -> None:
        """Subtract what was used; it can be overdrawn by as much as a burst."""
        self._left = max(self._saved() - amount, -self._burst)

    def pause(self) -> float:
        """Time [s] until it is not overdrawn; 0 if it is not, or by less than a millionth."""
        left = self._saved()
        return -left / self._per_second if left < -1e-6 else 0.0

    @property
    def is_unused(self) -> bool:
        """Whether a whole burst is allowed now."""
        return self._saved() >= self._burst

    def _saved(self) -> float:
        now = self._clock()
        saved = self._left + self._per_second * (now - self._counted_at)
        self._left, self._counted_at = min(self._burst, saved), now
        return self._left


class Rates:
    """A token bucket for each key, such as a process or a host."""

    def __init__(
        self, per_second: float, *, burst: float | None = None, clock: Callable[[], float]
    ) -> None:
        self._make = partial(RateLimiter, per_second, burst=burst, clock=clock)
        self._rates: dict[Hashable, RateLimiter] = {}

    def of(self, key: Hashable) -> RateLimiter:
        """The one of a key."""
        if len(self._rates) >= _MAX_RATES:
            self._rates = {key: each for key, each in self._rates.items() if not each.is_unused}
        return self._rates.setdefault(key, self._make())
