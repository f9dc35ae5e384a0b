"""Whether envelopes are loaded in time, by how long that took of late.

A wire that turns out too slow gets plain ramps. It may have been busy with something else, so it is
tried again: after half a minute, and after pauses twice as long each time it is too slow again.
"""

import logging

SLOW_IN_A_ROW = 3
"""One slow loading is a hiccup; so many in a row are how this wire is. As many in time make up."""

FIRST_PAUSE, LONGEST_PAUSE = 30.0, 480.0
"""Until it is tried again [s]: each time it may cost one touch a late onset."""

_logger = logging.getLogger(__name__)


class LoadingTimes:
    """Follows how long [s] the loading of envelopes takes; at most `longest` is in time.

    Times [s] are handed in and never go back.
    """

    def __init__(self, longest: float) -> None:
        self._longest = longest
        self._slow = 0  # in a row
        self._in_time = 0  # in a row
        self._pause = FIRST_PAUSE  # the next
        self._resumes = float("-inf")
        self._last = 0.0

    def took(self, duration: float, *, now: float) -> None:
        """Another loading took so long [s]."""
        self._last = duration
        if duration <= self._longest:
            self._slow = 0
            self._in_time += 1
            if self._in_time >= SLOW_IN_A_ROW:
                self._pause = FIRST_PAUSE
            return
        self._in_time = 0
        self._slow += 1
        is_known_as_slow = self._pause > FIRST_PAUSE
        if self._slow < SLOW_IN_A_ROW and not is_known_as_slow:
            return
        self._slow = 0
        self._resumes = now + self._pause
        self._pause = min(2 * self._pause, LONGEST_PAUSE)
        _logger.warning("there are plain ramps in place of envelopes: %s", self.problem(now))

    def problem(self, now: float) -> str | None:
        """Why none are to be loaded at a time, None where they are."""
        left = self._resumes - now
        if left <= 0:
            return None
        return (
            f"loading envelopes took {1000 * self._last:.0f} ms, and touches may wait for "
            f"{1000 * self._longest:.0f} ms; it is tried again in {left:.0f} s; use a "
            "faster wire, or let touches wait for longer"
        )
