"""The set under way to an amplifier: its parts as they were sent, and what is said of them."""

import math
from collections.abc import Sequence

from drivers.playing.uncertain import Interval
from drivers.protocol.records import Refusal, Values
from drivers.protocol.sets import Assembly, LayerSet, is_last, unpack_layers
from drivers.protocol.table import QUANTITIES, STAGED_LIFE

_MAX_WORDS = QUANTITIES["set_words"].maximum


class ExpectedSet:
    """The newest set to one amplifier; times [s]. is_exact: it plays to the word, as is said."""

    def __init__(self) -> None:
        self.is_exact = True
        self._sent = Assembly()
        self._whole: tuple[int, tuple[LayerSet, ...]] = (0, ())  # token, and layers
        self._replaced = 0  # token of a set of which it is known what really plays
        self._taken: set[int] = set()  # parts that have their reply
        self._token = self._staged = 0  # of these parts, of a set that is staged
        self._began: Interval = (-math.inf, -math.inf)  # when the first part came

    def drop(self) -> None:
        """Discard what is staged."""
        self._token = self._staged = 0

    def sent(self, part: Values, time: float) -> str:
        """Note a part that is sent; returns what is wrong with it, or ""."""
        if part["index"] >= part["parts"]:
            return f"index must be below {part['parts']}, got {part['index']}"
        if not is_last(part):
            is_kept = self._sent.keep(part, time)
            return "" if is_kept else f"parts must be {self._sent.count}, got {part['parts']}"
        stream = self._sent.whole(part)
        if isinstance(stream, int):
            return f"part {stream} must come before the last"
        try:
            self._whole = part["token"], unpack_layers(stream)
        except Refusal as refusal:
            return str(refusal)
        return ""

    def whole(self, token: int) -> tuple[LayerSet, ...] | None:
        """Return the layers of a set, all parts of which were sent."""
        return self._whole[1] if token == self._whole[0] else None

    def replace(self, token: int, layers: tuple[LayerSet, ...]) -> None:
        """Note what an amplifier really plays of a set."""
        self._whole, self.is_exact, self._replaced = (token, layers), True, token

    def staged_until(self, token: object) -> Interval:
        """Return until when a set is kept, at the least and at the most, if it is staged."""
        if not self._staged or token != self._staged:
            return -math.inf, -math.inf
        return self._began[0] + STAGED_LIFE, self._began[1] + STAGED_LIFE

    def taken(self, part: Values, reply: Values, when: Interval) -> list[Sequence[int]] | None:
        """Note the reply to a part that came within an interval.

        Returns what it may say: missing, staged and played; None where its set expired just
        then. A part without a reply may have come.
        """
        token, count = part["token"], part["parts"]
        lived = when[0] - self._began[1], when[1] - self._began[0]
        is_unclear = token == self._token and lived[0] <= STAGED_LIFE <= lived[1]
        if token != self._token or lived[1] > STAGED_LIFE:
            self._taken = set()
            self._token, self._began = token, (self._began[0] if is_unclear else when[0], when[1])
        self._taken.add(part["index"])
        if reply["staged"] or reply["played"]:
            self.is_exact = bool(reply["exact"]) or token == self._replaced
        self._staged = token if reply["staged"] else 0
        possible: list[Sequence[int]] = []
        for index in range(count):
            if index not in self._taken:
                possible.append((index, 0, 0))
            if index not in self._sent.collected:
                break
        else:
            possible.append((0, 1 - part["now"], part["now"]))
        return None if is_unclear else possible
