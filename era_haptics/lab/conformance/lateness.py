"""Lateness of this machine and of replies, which must not count against the amplifier.

A reply that is later than others of its kind was delayed by this machine, by an emulator, serial
server or adapter on the way, or by the amplifier.
"""

import asyncio
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager

from drivers.protocol.definition import REACTION
from registry import threads

FEW = 3
"""Number of occurrences that exclude chance lateness of this machine."""
ON_THE_WAY = "an emulator, serial server or adapter"
"""Causes of delays that this machine cannot tell from the amplifier."""
BUSY = 0.02
"""Lateness [s] up to which a violation counts when it is seen once."""
_MAX_ATTEMPTS = 20  # per check with all its cases, if this machine is late
_MAX_WASTED = 20.0  # s per run, for attempts that came too late
_INTERVAL = 0.005  # s; between two measurements of this machine's lateness


class Lateness:
    """Lateness during a run of checks."""

    def __init__(self) -> None:
        self.attempts = 0
        """Repetitions of the current check because of lateness."""
        self.wasted = 0.0
        """Total time of all repetitions in the run [s]."""
        self.lag = 0.0
        """Largest lateness of this machine in an attempt [s]."""
        self.delay = 0.0
        """Largest delay of a reply in an attempt, compared with the fastest in the run [s]."""
        self.largest = 0.0
        """Largest lateness of this machine, or of a reply, in the run [s]."""
        self.reactions: dict[str, list[float]] = defaultdict(list)
        """Times until a reply began [s], by message name, "refusals" for rejections."""

    @property
    def slow_reply(self) -> str:
        """Return which message it always answers too late, and by when; empty if none.

        None while this machine is late itself.
        """
        if self.is_machine_late:
            return ""
        for name, reactions in self.reactions.items():
            shortest = min(reactions, default=0.0)
            if len(reactions) >= FEW and shortest > REACTION:
                return (
                    f"its replies to {name} begin after at least {1e3 * shortest:.3g} ms,"
                    f" including any delay of {ON_THE_WAY}"
                )
        return ""

    @property
    def is_disturbing(self) -> bool:
        """Return whether lateness can have caused a violation in this attempt."""
        return max(self.lag, self.delay) > BUSY

    @property
    def is_machine_late(self) -> bool:
        """Return whether this machine was late in this attempt."""
        return self.lag > BUSY

    @property
    def cause(self) -> str:
        """Return what was late in this attempt, and by how much."""
        if self.slow_reply:
            return self.slow_reply
        if self.delay > 2 * self.lag:
            milliseconds = 1e3 * self.delay
            return f"a reply was {milliseconds:.0f} ms later than others: a delay of {ON_THE_WAY}"
        return f"this machine was late by {1e3 * self.lag:.0f} ms"

    def note_delay(self, delay: float) -> None:
        """Record that a reply was later than others [s]."""
        self.delay = max(self.delay, delay)
        self.largest = max(self.largest, delay)

    def start_attempt(self) -> None:
        """Forget the lateness of the attempt before."""
        self.lag = 0.0
        self.delay = 0.0

    @property
    def is_used_up(self) -> bool:
        """Return whether the run's time for late attempts is used up."""
        return self.wasted >= _MAX_WASTED

    def repeats(self, started_at: float) -> bool:
        """Record an attempt that was late; return whether to repeat it."""
        if self.slow_reply:
            return False
        self.attempts = min(self.attempts + 1, _MAX_ATTEMPTS)
        self.wasted += threads.now() - started_at
        return self.attempts < _MAX_ATTEMPTS and not self.is_used_up

    @contextmanager
    def measured(self) -> Iterator[None]:
        """Measure this machine's lateness during a check."""
        self.attempts = 0
        self.start_attempt()
        measuring = asyncio.create_task(self._measure(), name="how late this machine is")
        try:
            yield
        finally:
            measuring.cancel()

    async def _measure(self) -> None:
        while True:
            due = threads.now() + _INTERVAL
            await asyncio.sleep(_INTERVAL)
            late_by = threads.now() - due
            self.lag = max(self.lag, late_by)
            self.largest = max(self.largest, late_by)
