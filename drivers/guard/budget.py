"""What a guard allows over time: how many sets a second, and how long there may be vibration."""

from collections import deque

from drivers.errors import CommandRefused
from drivers.guard.limits import Bounds

DUTY_WINDOW = 10.0
"""Over which the duty is counted [s]; short against the time in which an amplifier warms up."""

_BURST = 1.0  # s; what was not used of the rate may be made up for within it
_ROUNDING = 1e-6  # of a set; whoever waits for one must not be sent away at its moment


class Budget:
    """Counts what was let through, by times [s] that are handed in and never go back."""

    def __init__(self, bounds: Bounds) -> None:
        self._rate = bounds.rate
        self._on_time = bounds.on_time
        self._duty_time = bounds.duty * DUTY_WINDOW if bounds.duty < 1 else None
        self._sets = bounds.rate * _BURST
        self._counted = 0.0
        self._vibrations: deque[tuple[float, float]] = deque()  # that are over: begin, end
        self._since: float | None = None  # when the present one began
        self._until = 0.0  # when it ends by itself

    def remaining(self, now: float) -> float | None:
        """How long a vibration that is asked for now may last [s]; None for no limit.

        Raises CommandRefused where there is nothing left, or sets come too fast.
        """
        self._settle(now)
        if self._sets < 1 - _ROUNDING:
            raise CommandRefused(
                f"more than {self._rate:g} command sets a second; send fewer, for the limit is "
                "there to stop a loop that runs wild",
                until=now + (1 - self._sets) / self._rate,
            )
        left = [self._on_time - (0.0 if self._since is None else now - self._since)]
        if self._duty_time is not None:
            left.append(self._duty_time - self._used(now))
        shortest = min(left)
        if shortest <= 0:
            raise CommandRefused(
                "the vibration has lasted for as long as the limits of on-time and duty allow; "
                "let it rest"
            )
        return None if shortest == float("inf") else shortest

    def note(self, now: float, *, lasts: float) -> None:
        """A set was let through: vibration for so long [s], 0 for silence."""
        self._settle(now)
        if lasts > 0:
            self._sets -= 1
            self._since = now if self._since is None else self._since
            self._until = now + lasts
        elif self._since is not None:
            self._end(now)

    def _settle(self, now: float) -> None:
        """What happened by itself until now."""
        if self._since is not None and self._until <= now:
            self._end(self._until)
        while self._vibrations and self._vibrations[0][1] < now - DUTY_WINDOW:
            self._vibrations.popleft()
        self._sets = min(self._rate * _BURST, self._sets + (now - self._counted) * self._rate)
        self._counted = now

    def _end(self, moment: float) -> None:
        if self._since is not None:
            self._vibrations.append((self._since, moment))
        self._since = None

    def _used(self, now: float) -> float:
        """Time with vibration within the window before now [s]."""
        opened = now - DUTY_WINDOW
        present = () if self._since is None else ((self._since, now),)
        spans = [end - max(begin, opened) for begin, end in (*self._vibrations, *present)]
        return sum((max(0.0, span) for span in spans), start=0.0)
