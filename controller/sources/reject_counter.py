"""Counting what was wrong with a stream of input without letting it flood the log."""

import logging
from collections import Counter
from collections.abc import Callable

from drivers import clock


class RejectCounter:
    """Counters by name and a log line at most once every `pause` [s].

    What happens within the pause is counted and told with the next line. `clock` gives seconds.
    """

    def __init__(
        self,
        logger: logging.Logger,
        *,
        pause: float = 1.0,
        clock: Callable[[], float] = clock.now,
    ) -> None:
        self.counts: Counter[str] = Counter()
        self._logger = logger
        self._pause = pause
        self._clock = clock
        self._untold = 0
        self._told_at: float | None = None

    def count(self, name: str, detail: str) -> None:
        """Count one event under a name and log its detail if the last line is long enough ago."""
        self.counts[name] += 1
        self._untold += 1
        now = self._clock()
        if self._told_at is not None and now - self._told_at < self._pause:
            return
        self._logger.warning(
            "%s: %s (%d since the last report; so far %s)",
            name.replace("_", " "),
            detail,
            self._untold,
            ", ".join(f"{key} {count}" for key, count in sorted(self.counts.items())),
        )
        self._untold = 0
        self._told_at = now
