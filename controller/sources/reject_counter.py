"""Counting rejected input without flooding the log."""

import logging
import math
from collections import Counter
from collections.abc import Callable

from registry import threads

LOG_INTERVAL = 1.0  # s


class RejectCounter:
    """Counts by reason, and logs each new one, others at most once per LOG_INTERVAL; clock [s]."""

    def __init__(
        self,
        logger: logging.Logger,
        *,
        clock: Callable[[], float] = threads.now,
    ) -> None:
        self.counts: Counter[str] = Counter()
        self.examples: dict[str, str] = {}
        """The newest detail of each reason, printable."""
        self._logger = logger
        self._clock = clock
        self._unlogged = 0
        self._logged_at = -math.inf

    def count(self, reason: str, detail: str) -> None:
        """Count one rejection; log its detail if the reason is new or the last line long ago."""
        self.counts[reason] += 1
        self.examples[reason] = detail if detail.isprintable() else ascii(detail)
        self._unlogged += 1
        now = self._clock()
        if self.counts[reason] > 1 and now - self._logged_at < LOG_INTERVAL:
            return
        self._logger.warning(
            "%s: %s (new=%d, total: %s)",
            reason.replace("_", " "),
            self.examples[reason],
            self._unlogged,
            ", ".join(f"{key} {count}" for key, count in sorted(self.counts.items())),
        )
        self._unlogged = 0
        self._logged_at = now
