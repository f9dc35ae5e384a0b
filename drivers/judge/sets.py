"""The set under way to an amplifier: its parts as they were sent, and what is said of them."""

import math
from collections.abc import Sequence

from drivers.playing.uncertain import Interval
from drivers.protocol.definition import STAGED_LIFE
from drivers.protocol.records import Refusal, Values
from drivers.protocol.sets import Assembly, LayerSet, is_newer_token, unpack_layers


class ExpectedSet:
    """The newest set to one amplifier; times [s]. is_exact: it plays to the word, as is said.

    staged: token of the set that is staged, 0 for none.
    """

    def __init__(self) -> None:
        self.is_exact = True
        self._whole: tuple[int, tuple[LayerSet, ...]] = (0, ())  # token, and layers
        self._replaced = 0  # token of a set of which it is known what really plays
        self.drop()

    def drop(self) -> None:
        """Discard what is collected or staged."""
        self._parts = Assembly()  # that are kept
        self.staged = 0
        self._began: Interval = (-math.inf, -math.inf)  # when the first part came
        self._is_unclear = False  # whether a part came before the set expired, or after

    def keep(self, part: Values, when: Interval) -> bool:
        """Note a part but the last that comes between two times; returns whether it is kept."""
        token = part["token"]
        self._expire(when)
        if token != self._parts.token:
            if not is_newer_token(token, self._parts.token):
                return False
            self.drop()
            self._began = when
        return not self.staged and self._parts.keep(part, when[1])

    def sent(self, last: Values) -> str:
        """Note the last part of a set that is sent; returns what is wrong with it, or ""."""
        stream = self._parts.whole(last)
        try:
            if not isinstance(stream, int):
                self._whole = last["token"], unpack_layers(stream)
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
        if not self.staged or token != self.staged:
            return -math.inf, -math.inf
        return self._began[0] + STAGED_LIFE, self._began[1] + STAGED_LIFE

    def taken(self, last: Values, reply: Values, when: Interval) -> Sequence[int] | None:
        """Note the reply to the last part of a set, which came within an interval.

        Returns what it must say: missing, staged and played; None where its set expired just then.
        """
        token = last["token"]
        self._expire(when)
        is_unclear, is_under_way = self._is_unclear, token == self._parts.token
        stream = [] if is_under_way and self.staged else self._parts.whole(last)
        if reply["staged"] or reply["played"]:
            self.is_exact = bool(reply["exact"]) or token == self._replaced
            if not is_under_way:
                self.drop()
                self._parts, self._began = Assembly(token, last["parts"], when[1]), when
            self.staged = token if reply["staged"] else 0
            self._began = self._began[0], (when[1] if is_unclear else self._began[1])
        elif is_under_way:
            self.staged = 0
            self._parts.collected.pop(reply["missing"], None)
        if is_unclear:
            return None
        if isinstance(stream, int):
            return stream, 0, 0
        return 0, 1 - last["now"], last["now"]

    def refused(self, last: Values) -> None:
        """Note that a last part was refused, with its set where all others are there."""
        is_own = last["token"] == self._parts.token and not self.staged
        is_one = last["index"] < last["parts"] == self._parts.count
        if is_own and is_one and not isinstance(self._parts.whole(last), int):
            self.drop()

    def _expire(self, when: Interval) -> None:
        """Drop what has expired by an interval."""
        lived = when[0] - self._began[1], when[1] - self._began[0]
        if lived[0] > STAGED_LIFE:
            self.drop()
        self._is_unclear |= lived[0] <= STAGED_LIFE < lived[1]
