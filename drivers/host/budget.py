"""Budget: the rate of sets, and the on-time and duty of vibrations."""

import math
from collections import deque
from typing import TypeAlias

from drivers.errors import CommandRefused
from registry.limits import GuardLimits

RATE_CEILING = 2000.0
"""Sets a second; no wire carries more, so a higher rate can only be a runaway loop."""

DUTY_WINDOW = 10.0
"""Window of the duty limit [s]; it is short against an amplifier's thermal time constant."""

COMMIT_DELAY = 0.1
"""Longest time from sending a set until it plays [s]: three attempts of 30 ms each."""

_RATE_WINDOW = 1.0  # s

VibrationSpan: TypeAlias = tuple[float | None, float]
"""Earliest start [s] of a vibration, None without a vibration, and its latest end [s]."""


class Budget:
    """Counts the sets that were sent, and how long they may have vibrated; times are in s."""

    def __init__(self, limits: GuardLimits) -> None:
        self._limits = limits
        self._rate = min(limits.rate, RATE_CEILING)
        self.is_unlimited = limits.on_time == math.inf and limits.duty >= 1
        self._duty_time = limits.duty * DUTY_WINDOW if limits.duty < 1 else math.inf
        allowed = max(1, int(self._rate * _RATE_WINDOW))
        # Sets that were delayed on their way arrive closer together than they were sent.
        self._window = max(_RATE_WINDOW, allowed / self._rate) + COMMIT_DELAY
        self._sent: deque[float] = deque(maxlen=allowed)
        """When the latest sets were sent; at most as many as a window allows."""
        self._vibrations: deque[tuple[float, float]] = deque()
        """Start and end of earlier vibrations."""
        self._start: float | None = None
        """Earliest start of the current vibration; None without one."""
        self._end = 0.0
        """Latest end of the current vibration."""

    def remaining(self, now: float, *, fade: float, delay: float) -> float:
        """Return the longest valid_for [s] of a vibration that is sent now; infinite if unlimited.

        fade: how long it takes to end after that [s]. delay: longest time until it plays [s], while
        the current vibration goes on. Raises CommandRefused if no time is left or the rate is
        exceeded.
        """
        if len(self._sent) == self._sent.maxlen and now < self._sent[0] + self._window:
            raise CommandRefused(
                f"rate must be at most {self._rate:g} command sets a second; send fewer, "
                "the limit stops runaway loops",
                until=self._sent[0] + self._window,
            )
        if self.is_unlimited:
            return math.inf
        spent = fade
        used = 0.0
        if self._start is not None and now < self._end:
            spent += delay
            used = now - self._start
        duty_used = self._used(now)
        return min(
            _left("on-time limit", used, self._limits.on_time, spent),
            _left(f"duty limit over {DUTY_WINDOW:g} s", duty_used, self._duty_time, spent),
        )

    def fade_left(self, now: float) -> float:
        """Return how long the current vibration may fade [s] if silence is sent now."""
        if self._start is None or now >= self._end:
            return math.inf
        duty_left = self._duty_time - self._used(now)
        on_time_left = self._limits.on_time - (now - self._start)
        return max(0.0, min(duty_left, on_time_left) - COMMIT_DELAY)

    def sent(self, now: float, *, lasts: float) -> VibrationSpan | None:
        """Note a set that vibrates for `lasts` [s] at most; returns the vibration before it."""
        self._sent.append(now)
        if self.is_unlimited:
            return None
        self._close(now)
        last_vibration = self._start, self._end
        if self._start is None:
            self._start = now
            self._end = now
        self._end = max(self._end, now + COMMIT_DELAY + lasts)
        return last_vibration

    def restore(self, vibration: VibrationSpan | None) -> None:
        """Restore the vibration that `sent` returned, because the set was not played."""
        if vibration is not None:
            self._start, self._end = vibration

    def confirm(self, sent_at: float, now: float, *, end: float) -> None:
        """Note that the set sent at a time [s] plays, and when it ends at the latest [s]."""
        self._close(now)
        if self._start is None and now < end:
            self._start = sent_at
        self._end = end

    def _close(self, now: float) -> None:
        """Store the current vibration once it has ended."""
        if self._start is not None and self._end <= now:
            self._vibrations.append((self._start, self._end))
            self._start = None
        while self._vibrations and self._vibrations[0][1] < now - DUTY_WINDOW:
            self._vibrations.popleft()

    def _used(self, now: float) -> float:
        """Return the time of vibration within the window that ends now [s]."""
        vibrations = [*self._vibrations]
        if self._start is not None:
            vibrations.append((self._start, min(now, self._end)))
        used = 0.0
        for start, end in vibrations:
            used += max(0.0, end - max(start, now - DUTY_WINDOW))
        return used


def _left(name: str, used: float, limit: float, spent: float) -> float:
    """Return how much time is left of a limit [s]; raises CommandRefused if none is."""
    left = limit - used - spent
    if left <= 0:
        raise CommandRefused(
            f"{name} of {limit:.3g} s reached ({used:.3g} s used, {spent:.3g} s to end); pause the "
            "vibration"
        )
    return left
