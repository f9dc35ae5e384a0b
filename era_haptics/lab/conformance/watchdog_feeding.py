"""Feeding of the watchdog of the amplifier under test.

A check that drives the amplifier feeds its watchdog after a quarter of the watchdog time. If this
machine is so late that the watchdog can have expired, the check is repeated.
"""

from drivers.protocol.definition import ENABLED
from era_haptics.lab.conformance.judge import Judge
from era_haptics.lab.conformance.outcomes import require_in_time
from registry import threads

_MAX_USE = 0.8  # share of the watchdog time; later, it can have expired
_HUNGRY = 0.25  # share of the watchdog time after which it is fed
_SLEEP = 1 / 8  # share of the watchdog time, between two looks at it


class WatchdogFeeding:
    """When the watchdog must be fed, according to the expected state."""

    def __init__(self) -> None:
        self.judge: Judge | None = None
        """Expected state; None until the amplifier was brought to rest."""
        self.is_starving = True
        """Whether the watchdog is not fed, and may expire."""

    def starve(self) -> None:
        """Stop feeding: from now on the watchdog may expire."""
        self.is_starving = True

    @property
    def used(self) -> float:
        """Share of the watchdog time that has passed; 0 if it need not be fed."""
        judge = self._judge_to_feed
        return (
            0.0
            if judge is None
            else (threads.now() - judge.watchdog.fed.earliest) / judge.watchdog.time
        )

    @property
    def is_due(self) -> bool:
        """Return whether the watchdog must be fed now."""
        return self.used > _HUNGRY

    def require_fed(self) -> None:
        """Raise TooLate if this machine can have missed the watchdog's deadline."""
        require_in_time(self.used <= _MAX_USE, "the watchdog was not fed in time")

    def sleep_time(self, remaining: float) -> float:
        """Return how long [s] of a remaining time to sleep before the next look at the watchdog."""
        judge = self._judge_to_feed
        return remaining if judge is None else min(remaining, _SLEEP * judge.watchdog.time)

    @property
    def _judge_to_feed(self) -> Judge | None:
        """The expected state if the watchdog counts and must be fed, else None."""
        judge = self.judge
        must_feed = judge is not None and judge.state == ENABLED and not self.is_starving
        return judge if must_feed else None
