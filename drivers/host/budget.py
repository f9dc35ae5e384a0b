"""Limits over time: command sets per second, on-time and duty."""

from collections import deque
from typing import TypeAlias

from drivers.errors import CommandRefused
from registry.limits import GuardLimits

DUTY_WINDOW = 10.0
"""Window of the duty limit [s]; short against the thermal time constant of an amplifier."""

COMMIT_DELAY = 0.1
"""Longest time [s] from sending a set until it is played: three attempts of 30 ms each."""

CHECK_DELAY = 0.25
"""Longest time [s] from a check until the set is played, envelopes loaded in between."""

_RATE_WINDOW = 1.0  # s

Vibration: TypeAlias = tuple[float | None, float]
"""Earliest start [s] of a vibration, None without one, and its latest end [s]."""


class Budget:
    """Sets sent and the longest time they may vibrate; times [s] are arguments."""

    def __init__(self, limits: GuardLimits) -> None:
        self._limits = limits
        self.is_unlimited = limits.on_time == float("inf") and limits.duty >= 1
        self._duty_time = limits.duty * DUTY_WINDOW if limits.duty < 1 else float("inf")
        allowed = max(1, int(limits.rate * _RATE_WINDOW))
        # Sets that were delayed on their way arrive closer together than they were sent.
        self._window = max(_RATE_WINDOW, allowed / limits.rate) + COMMIT_DELAY
        self._sent: deque[float] = deque(maxlen=allowed)
        self._vibrations: deque[tuple[float, float]] = deque()  # ended ones: start, end
        self._start: float | None = None  # earliest start of the current one
        self._end = 0.0  # its latest end

    def remaining(self, now: float, *, fade: float, delay: float = CHECK_DELAY) -> float:
        """Longest valid_for [s] of a vibration that is sent now, infinite if unlimited.

        fade [s]: how long it takes to end after that; delay [s]: allowance until it is played,
        while the current vibration goes on. Raises CommandRefused if no time is left or the rate is
        exceeded.
        """
        if len(self._sent) == self._sent.maxlen and now < self._sent[0] + self._window:
            raise CommandRefused(
                f"rate must be at most {self._limits.rate:g} command sets a second; send fewer, "
                "the limit stops runaway loops",
                until=self._sent[0] + self._window,
            )
        if self.is_unlimited:
            return float("inf")
        is_vibrating = self._start is not None and now < self._end
        spent = fade + (delay if is_vibrating else 0.0)
        used = now - self._start if is_vibrating and self._start is not None else 0.0
        return min(
            _left("on-time limit", used, self._limits.on_time, spent),
            _left(f"duty limit over {DUTY_WINDOW:g} s", self._used(now), self._duty_time, spent),
        )

    def fade_left(self, now: float) -> float:
        """Longest time [s] in which the current vibration may fade if silence is sent now."""
        if self._start is None or now >= self._end:
            return float("inf")
        used = max(self._used(now) - self._duty_time, now - self._start - self._limits.on_time)
        return max(0.0, -used - COMMIT_DELAY)

    def sent(self, now: float, *, lasts: float) -> Vibration:
        """Note a set that vibrates for at most a time [s], fade included; what vibrated before."""
        self._sent.append(now)
        self._close(now)
        before = self._start, self._end
        if self._start is None:
            self._start, self._end = now, now
        self._end = max(self._end, now + COMMIT_DELAY + lasts)
        return before

    def restore(self, before: Vibration | None) -> None:
        """Note that the set sent last was refused; before: as `sent` returned."""
        if before is not None:
            self._start, self._end = before

    def confirm(self, sent_at: float, now: float, *, end: float) -> None:
        """Note that the set sent at a time [s] plays, and ends at another at the latest."""
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
        """Vibration time within the window before now [s]."""
        opened = now - DUTY_WINDOW
        current = () if self._start is None else ((self._start, min(now, self._end)),)
        spans = [end - max(start, opened) for start, end in (*self._vibrations, *current)]
        return sum((max(0.0, span) for span in spans), start=0.0)


def _left(name: str, used: float, limit: float, spent: float) -> float:
    """Return the time [s] of a limit that is not spent; CommandRefused if none."""
    left = limit - used - spent
    if left <= 0:
        raise CommandRefused(
            f"{name} of {limit:.3g} s reached ({used:.3g} s used, {spent:.3g} s to end); pause the "
            "vibration"
        )
    return left
