"""Turns of short pulses: pulses of different fingers start 60 ms apart."""

import math
from collections.abc import Collection

from controller.play.intent import Pulse
from controller.sources.touch import ContactKey
from model.transients.excursions import CLICKS_APART

# A short pulse that would wait longer [s], two turns plus rounding, is left out.
_MAX_WAIT = 2 * CLICKS_APART + 0.005


class ClickTurns:
    """Assigns turns to the short pulses of all fingers; times are arguments.

    Only the newest pulse of each finger waits. A pulse without a turn, or replaced by a newer one
    while it waited, has an infinite `Pulse.due_at`.
    """

    def __init__(self) -> None:
        self._waiting: dict[ContactKey, Pulse] = {}
        self._last: tuple[ContactKey, Pulse] | None = None  # the pulse that had the latest turn

    def is_waiting(self, key: ContactKey) -> bool:
        """Whether a pulse of a finger waits."""
        return key in self._waiting

    def keep(self, keys: Collection[ContactKey]) -> None:
        """Forget the waiting pulses of all fingers but these."""
        self._waiting = {key: pulse for key, pulse in self._waiting.items() if key in keys}

    def start_of(self, key: ContactKey, pulse: Pulse, now: float) -> float:
        """Return when [s] a pulse starts; infinite for never."""
        if pulse.started_at is not None:
            return now
        if math.isinf(pulse.due_at):
            self._line_up(key, pulse)
        if self._waiting.get(key) is not pulse:
            has_had_turn = math.isfinite(pulse.due_at)
            return now if has_had_turn else math.inf
        last_start = self._last_start_of_others(key)
        # The last pulse can have started later than it was due.
        pulse.due_at = max(pulse.due_at, last_start + CLICKS_APART)
        if now >= pulse.due_at:
            del self._waiting[key]
            self._last = key, pulse
        return pulse.due_at

    def _line_up(self, key: ContactKey, pulse: Pulse) -> None:
        """Give a pulse the turn of its finger's waiting pulse, or else the last turn."""
        replaced = self._waiting.get(key)
        if replaced is not None:
            pulse.due_at = replaced.due_at
            replaced.due_at = -math.inf
        else:
            turns = [waiting.due_at for waiting in self._waiting.values()]
            last_turn = max([*turns, self._last_start_of_others(key)])
            due_at = max(pulse.requested_at, last_turn + CLICKS_APART)
            if due_at > pulse.requested_at + _MAX_WAIT:
                return
            pulse.due_at = due_at
        self._waiting[key] = pulse

    def _last_start_of_others(self, key: ContactKey) -> float:
        """Return when [s] the latest pulse started, -inf if it was at this finger."""
        if self._last is None or self._last[0] == key:
            return -math.inf
        return self._last[1].start
