"""Which fingers are on the plate, by the touch frames alone and docs/reference/touch.md."""

import math
from collections.abc import Sequence
from typing import TypeAlias

CONTACT_TIMEOUT = 0.150  # s; a source without news for so long has lost its fingers
_GLIMPSE = 0.005  # s; a finger that is gone sooner may have come and gone between two cycles,
_TAP = 0.060  # s; and then counts for so long, so that a tap is felt

FrameTouches: TypeAlias = Sequence[tuple[int, float, float]]
"""Of one frame: id, x, y, where 0 to 1 is the plate."""


class SourceContacts:
    """The contacts of every source, by source and id; times [s]."""

    def __init__(self) -> None:
        self._now: dict[str, tuple[float, frozenset[tuple[str, int]]]] = {}
        self._until: dict[str, float] = {}  # by source: end of its contacts
        self._since: dict[tuple[str, int], float] = {}
        self._taps: dict[tuple[str, int], float] = {}  # when those end that are lifted already

    def frame(self, source: str, stamp: float, touches: FrameTouches, now: float) -> None:
        """A frame has been delivered, and replaces what its source has said before."""
        last = {number: (x, y) for number, x, y in touches}
        numbers = frozenset(
            (source, number)
            for number, (x, y) in last.items()
            if 0 <= x <= 1 and 0 <= y <= 1  # NaN is not
        )
        _, were = self._now.get(source, (0.0, frozenset[tuple[str, int]]()))
        for key in were - numbers:
            if stamp - self._since[key] < _GLIMPSE:
                self._taps[key] = self._since[key] + _TAP
        self._since |= dict.fromkeys(numbers - were, stamp)
        end = min(stamp, now) + CONTACT_TIMEOUT if math.isfinite(stamp) else -math.inf
        self._now[source] = end, numbers
        before = min(self._until.get(source, -math.inf), now)
        self._until[source] = max(end if numbers else -math.inf, before)

    @property
    def last(self) -> float:
        """When the plate is or was touched last, as far as is known."""
        return max([*self._until.values(), *self._taps.values()], default=-math.inf)

    def at(self, now: float) -> frozenset[tuple[str, int]]:
        """All that are on the plate."""
        taps = {key for key, end in self._taps.items() if now < end}
        return frozenset(taps).union(*(keys for end, keys in self._now.values() if now < end))

    def next_end(self, now: float) -> float:
        """When the first source is overdue if nothing more is heard; infinity if none can be."""
        ends = [end for end, keys in self._now.values() if keys]
        return min((end for end in (*ends, *self._taps.values()) if end > now), default=math.inf)
