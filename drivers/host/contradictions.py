"""Statuses of an amplifier that contradict the requests sent to it, counted in a row.

What contradicts the requests is decided by `Amplifier`; when that is a fault, here.
"""

import math

MAX_CONTRADICTIONS = 2
"""So many contradictions in a row are a fault; a single one may be a moment between two sets."""
_SAME_MOMENT = 0.01  # s; contradictions of statuses closer to each other than this count once


class StatusContradictions:
    """The contradictory statuses of one amplifier in a row."""

    count: int = 0
    """Number of contradictory statuses in a row."""
    _last_at: float = -math.inf
    """When the last contradictory status came [s]."""
    _was_unfed: bool = False
    """Whether the last contradiction was in a status that does not feed."""

    def restart(self) -> None:
        """Count from zero again, because the amplifier was armed."""
        self.count = 0

    def note_agreement(self, *, shows_watchdog: bool) -> None:
        """Note a status without contradiction, which ends the row.

        shows_watchdog: whether the status shows how the watchdog runs down. Only such a status ends
        a row whose last contradiction was in a status that does not feed.
        """
        if shows_watchdog or not self._was_unfed:
            self.count = 0
            self._last_at = -math.inf

    def note_contradiction(self, now: float, *, is_fed: bool) -> bool:
        """Note a contradictory status that came now [s]; return whether the row is a fault.

        is_fed: whether the request for the status feeds the watchdog.
        """
        self._was_unfed = not is_fed
        if now - self._last_at < _SAME_MOMENT:
            return False
        self.count += 1
        self._last_at = now
        return self.count >= MAX_CONTRADICTIONS
