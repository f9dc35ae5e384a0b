"""Whether envelopes are loaded in time, judged by the recent loading times.

A wire that turns out too slow gets plain ramps. It may have been busy with something else, so
loading is retried after half a minute, and after twice the pause each time it is too slow again.
"""

import logging

MAX_SLOW = 3
"""Consecutive slow loads before falling back to ramps; as many fast ones reset the backoff."""

FIRST_PAUSE, MAX_PAUSE = 30.0, 480.0
"""First and longest time [s] until loading is retried; a retry may delay the onset of a touch."""

_logger = logging.getLogger(__name__)


class LoadingTimes:
    """Follows how long [s] loading envelopes takes; at most `max_loading_time` is in time.

    Times [s] are arguments and never decrease.
    """

    def __init__(self, max_loading_time: float) -> None:
        self._max_loading_time = max_loading_time
        self._slow_in_a_row = 0
        self._in_time_in_a_row = 0
        self._pause = FIRST_PAUSE  # the next
        self._resumes = float("-inf")
        self._last = 0.0
        self._was_given_up = False

    def note(self, duration: float, *, now: float, is_late: bool = False) -> None:
        """Note that a loading took so long [s]; is_late: and was given up."""
        self._last = duration
        self._was_given_up = is_late
        if duration <= self._max_loading_time and not is_late:
            self._slow_in_a_row = 0
            self._in_time_in_a_row += 1
            if self._in_time_in_a_row >= MAX_SLOW:
                self._pause = FIRST_PAUSE
            return
        self._in_time_in_a_row = 0
        self._slow_in_a_row += 1
        is_backing_off = self._pause > FIRST_PAUSE
        if self._slow_in_a_row < MAX_SLOW and not is_backing_off:
            return
        self._slow_in_a_row = 0
        self._resumes = now + self._pause
        self._pause = min(2 * self._pause, MAX_PAUSE)
        _logger.warning("loop: plain ramps instead of envelopes: %s", self.ramp_only_reason(now))

    def ramp_only_reason(self, now: float) -> str | None:
        """Return why no envelopes are to be loaded at a time [s], None if they are."""
        left = self._resumes - now
        if left <= 0:
            return None
        took = (
            f"given up after {1000 * self._last:.0f} ms since it would have exceeded"
            if self._was_given_up
            else f"took {1000 * self._last:.0f} ms, more than"
        )
        return (
            f"loading envelopes {took} the {1000 * self._max_loading_time:.0f} ms that a touch may "
            f"wait; retrying in {left:.0f} s; use a faster wire, or allow a longer wait"
        )
