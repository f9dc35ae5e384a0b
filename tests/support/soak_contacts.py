"""Which fingers are on the plate, by the touch frames alone and docs/reference/touch.md."""

import math
from collections.abc import Sequence
from typing import TypeAlias

CONTACT_TIMEOUT = 0.150  # s; a source without news for so long has lost its fingers

FrameTouches: TypeAlias = Sequence[tuple[int, float, float]]
"""Of one frame: id, x, y, where 0 to 1 is the plate."""


class SourceContacts:
    """The contacts of every source, by source and id; times [s]."""

    def __init__(self) -> None:
        self._now: dict[str, tuple[float, frozenset[tuple[str, int]]]] = {}
        self._until: dict[str, float] = {}  # by source: end of its contacts

    def frame(self, source: str, stamp: float, touches: FrameTouches, now: float) -> None:
        """A frame has been delivered, and replaces what its source has said before."""
        last = {number: (x, y) for number, x, y in touches}
        numbers = frozenset(
            (source, number)
            for number, (x, y) in last.items()
            if 0 <= x <= 1 and 0 <= y <= 1  # NaN is not
        )
        end = min(stamp, now) + CONTACT_TIMEOUT if math.isfinite(stamp) else -math.inf
        self._now[source] = end, numbers
        before = min(self._until.get(source, -math.inf), now)
        self._until[source] = max(end if numbers else -math.inf, before)

    @property
    def last(self) -> float:
        """When the plate is or was touched last, as far as is known."""
        return max(self._until.values(), default=-math.inf)

    def at(self, now: float) -> frozenset[tuple[str, int]]:
        """All that are on the plate."""
        return frozenset().union(*(keys for end, keys in self._now.values() if now < end))

    def next_end(self, now: float) -> float:
        """When the first source is overdue if nothing more is heard; infinity if none can be."""
        ends = [end for end, keys in self._now.values() if keys and end > now]
        return min(ends, default=math.inf)
