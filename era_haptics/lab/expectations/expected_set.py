"""Expected set of an amplifier: collected in parts, then staged, until it plays or expires."""

import math

from drivers.protocol.definition import STAGED_LIFE
from drivers.protocol.records import Refusal, Values
from drivers.protocol.sets import Assembly, LayerSet, is_newer_token, unpack_layers
from era_haptics.lab.expectations.tolerances import Interval

_PAST = Interval(-math.inf, -math.inf)


class ExpectedSet:
    """The newest set sent to one amplifier; times [s]. is_exact: it plays without rounding.

    staged: token of the staged set, 0 for none. has_expired: a set may have expired already.
    """

    def __init__(self) -> None:
        self.is_exact = True
        self.has_expired = False
        self._whole_token = 0  # of the last set whose parts were all sent
        self._whole_layers: tuple[LayerSet, ...] = ()
        self._achieved_token = 0  # of the set whose achieved values are known
        self.drop()

    def drop(self) -> None:
        """Discard all collected and staged parts."""
        self._parts = Assembly()
        self.staged = 0
        self._began = _PAST  # when the first part arrived
        self._is_unclear = False  # whether a part may have arrived after the set expired

    # Parts

    def keep(self, part: Values, when: Interval) -> bool:
        """Record a part other than the last that arrives in an interval; returns whether it is
        kept."""
        token = part["token"]
        self.expire(when)
        if token != self._parts.token:
            if not is_newer_token(token, self._parts.token):
                return False
            self.drop()
            self._began = when
        return not self.staged and self._parts.keep(part, when.latest)

    def sent(self, last: Values) -> str:
        """Record that the last part of a set was sent; returns its error, or ""."""
        if self._parts.first_missing(last) is not None:
            return ""
        try:
            self._whole_layers = unpack_layers(self._parts.stream(last))
        except Refusal as refusal:
            return str(refusal)
        self._whole_token = last["token"]
        return ""

    def taken(self, last: Values, reply: Values, when: Interval) -> tuple[int, int, int] | None:
        """Record the reply to the last part of a set, which arrived within an interval.

        Returns the expected `missing`, `staged` and `played`; None if the set expired in that
        interval.
        """
        self.expire(when)
        is_unclear = self._is_unclear
        is_collected = last["token"] == self._parts.token
        is_repeated = is_collected and self.staged != 0
        missing = None if is_repeated else self._parts.first_missing(last)
        if reply["staged"] or reply["played"]:
            self._note_whole(last, reply, when)
        elif is_collected:
            self.staged = 0
            self._parts.collected.pop(reply["missing"], None)
        if is_unclear:
            return None
        if missing is not None:
            return missing, 0, 0
        return 0, 1 - last["now"], last["now"]

    def _note_whole(self, last: Values, reply: Values, when: Interval) -> None:
        """Record that a set is whole, and staged or played."""
        token = last["token"]
        was_unclear = self._is_unclear
        self.is_exact = bool(reply["exact"]) or token == self._achieved_token
        if token != self._parts.token:
            self.drop()
            self._parts = Assembly(token, last["parts"], when.latest)
            self._began = when
        self.staged = token if reply["staged"] else 0
        if was_unclear:
            self._began = Interval(self._began.earliest, when.latest)

    def refused(self, last: Values) -> None:
        """Record that a last part was rejected, and with it the set if all other parts arrived."""
        is_collected = last["token"] == self._parts.token and not self.staged
        has_valid_index = last["index"] < last["parts"] == self._parts.count
        is_whole = self._parts.first_missing(last) is None
        if is_collected and has_valid_index and is_whole:
            self.drop()

    # Whole sets

    def whole(self, token: int) -> tuple[LayerSet, ...] | None:
        """Return the layers of a set if all its parts were sent."""
        return self._whole_layers if token == self._whole_token else None

    def replace(self, token: int, layers: tuple[LayerSet, ...]) -> None:
        """Record the achieved layers of a set."""
        self._whole_token = token
        self._whole_layers = layers
        self._achieved_token = token
        self.is_exact = True

    # Expiry

    def staged_until(self, token: object) -> Interval:
        """Return the interval in which a set expires if it is staged."""
        if not self.staged or token != self.staged:
            return _PAST
        return Interval(self._began.earliest + STAGED_LIFE, self._began.latest + STAGED_LIFE)

    def expire(self, when: Interval) -> None:
        """Drop the set if it expired before the end of an interval."""
        min_age = when.earliest - self._began.latest
        max_age = when.latest - self._began.earliest
        self.has_expired |= STAGED_LIFE < max_age < math.inf
        if min_age > STAGED_LIFE:
            self.drop()
        self._is_unclear |= min_age <= STAGED_LIFE < max_age
