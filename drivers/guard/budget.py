"""Limits over time: command sets per second, on-time and duty."""

from collections import deque

from drivers.errors import CommandRefused
from drivers.guard.limits import GuardLimits

DUTY_WINDOW = 10.0
"""Window of the duty limit [s]; short against the thermal time constant of an amplifier."""

_BURST = 1.0  # s; unused rate can be caught up within it
_ROUNDING = 1e-6  # of a set; a caller that waits until the given moment must pass


class Budget:
    """Counts checked sets and vibration time; times [s] are arguments and never decrease."""

    def __init__(self, limits: GuardLimits) -> None:
        self._rate = limits.rate
        self._on_time = limits.on_time
        self._duty_time = limits.duty * DUTY_WINDOW if limits.duty < 1 else None
        self._allowance = limits.rate * _BURST  # sets that may be sent now
        self._counted = 0.0
        self._vibrations: deque[tuple[float, float]] = deque()  # ended ones: begin, end
        self._since: float | None = None  # begin of the present one
        self._until = 0.0  # end of the present one by valid_for

    def remaining(self, now: float) -> float | None:
        """Longest vibration [s] that may start now; None if unlimited.

        Raises CommandRefused if no time is left or the rate is exceeded.
        """
        self._refill(now)
        if self._allowance < 1 - _ROUNDING:
            raise CommandRefused(
                f"rate must be at most {self._rate:g} command sets a second; send fewer, the limit "
                "stops runaway loops",
                until=now + (1 - self._allowance) / self._rate,
            )
        used = 0.0 if self._since is None else now - self._since
        left = [_left("on-time limit", used, self._on_time)]
        if self._duty_time is not None:
            name = f"duty limit over {DUTY_WINDOW:g} s"
            left.append(_left(name, self._used(now), self._duty_time))
        shortest = min(left)
        return None if shortest == float("inf") else shortest

    def note(self, now: float, *, lasts: float) -> None:
        """Count a checked set: vibration for a time [s], 0 for silence."""
        self._refill(now)
        if lasts > 0:
            self._allowance -= 1
            self._since = now if self._since is None else self._since
            self._until = now + lasts
        elif self._since is not None:
            self._end(now)

    def _refill(self, now: float) -> None:
        """Advance the token bucket and end expired vibrations."""
        if self._since is not None and self._until <= now:
            self._end(self._until)
        while self._vibrations and self._vibrations[0][1] < now - DUTY_WINDOW:
            self._vibrations.popleft()
        self._allowance = min(
            self._rate * _BURST, self._allowance + (now - self._counted) * self._rate
        )
        self._counted = now

    def _end(self, moment: float) -> None:
        if self._since is not None:
            self._vibrations.append((self._since, moment))
        self._since = None

    def _used(self, now: float) -> float:
        """Vibration time within the window before now [s]."""
        opened = now - DUTY_WINDOW
        present = () if self._since is None else ((self._since, now),)
        spans = [end - max(begin, opened) for begin, end in (*self._vibrations, *present)]
        return sum((max(0.0, span) for span in spans), start=0.0)


def _left(name: str, used: float, limit: float) -> float:
    """Return the time [s] that a limit leaves; CommandRefused if none."""
    left = limit - used
    if left <= 0:
        raise CommandRefused(f"{name} ({used:.3g} s of {limit:.3g} s) reached; pause the vibration")
    return left
