"""Intake of sets in a simulated amplifier: collected in parts, staged, and committed."""

from collections.abc import Sequence
from typing import NamedTuple, TypeAlias

from drivers.protocol.records import Refusal, Values
from drivers.protocol.sets import Assembly, LayerSet, is_newer_token, unpack_layers

Layers: TypeAlias = tuple[LayerSet, ...]


class TakenSet(NamedTuple):
    """A set after its last part was taken."""

    layers: Layers = ()
    """Its layers; empty while a part is missing."""
    missing: int | None = None
    """Number of the first missing part; None if the set is complete."""


class SetIntake:
    """Collects the parts of sets, and stores a complete set until it is committed.

    capabilities: values of its record. committed: token of the set committed last, 0 for none.
    At most one set is under way: collected, or staged.
    """

    def __init__(self, capabilities: Values) -> None:
        self.capabilities = capabilities
        self.committed = 0
        self._parts = Assembly()  # of the set under way
        self._staged: Layers | None = None  # of the same set, once it is complete

    def keep(self, part: Values, now: float) -> bool:
        """Take a part other than the last at a time [s]; returns whether it is kept."""
        token = part["token"]
        under_way = self._under_way(now)
        is_newer = token != under_way and is_newer_token(token, under_way)
        is_under_way = token == under_way and self._staged is None
        if not (is_newer_token(token, self.committed) and (is_newer or is_under_way)):
            return False
        if is_newer:
            self._staged = None
        return self._parts.keep(part, now)

    def take(self, part: Values, now: float) -> TakenSet:
        """Take the last part of a set that was not committed, at a time [s]; stage a complete set.

        Raises Refusal; this drops only the parts of this set, and only if it is complete.
        """
        token = part["token"]
        under_way = self._under_way(now)
        is_under_way = token == under_way
        if is_under_way and self._staged is not None:  # a repetition
            return TakenSet(self._staged)
        replaced = 0 if is_under_way else under_way
        for older in (self.committed, replaced):
            if not is_newer_token(token, older):
                raise Refusal(f"token must be newer than {older}, got {token}", "BAD_TOKEN")
        self._check_numbers(part, is_under_way=is_under_way)
        missing = self._parts.first_missing(part)
        if missing is not None:
            return TakenSet(missing=missing)
        try:
            layers = self._checked(self._parts.stream(part))
        except Refusal:
            if is_under_way:
                self.drop()
            raise
        if not is_under_way:
            self._parts = Assembly(token, part["parts"], now)
        self._staged = layers
        return TakenSet(layers)

    def _check_numbers(self, part: Values, *, is_under_way: bool) -> None:
        """Raise Refusal for a part whose index or number of parts cannot be."""
        if part["index"] >= part["parts"]:
            raise Refusal(f"index must be below {part['parts']}, got {part['index']}")
        if is_under_way and part["parts"] != self._parts.count:
            raise Refusal(f"parts must be {self._parts.count} as before, got {part['parts']}")

    def commit(self, token: int, now: float) -> Layers | None:
        """Return the layers of the staged set; None if it was already committed.

        Raises Refusal if none is staged under this token.
        """
        if token == self.committed:
            return None
        if token != self._under_way(now):
            raise Refusal(f"no set is staged under token {token}", "BAD_TOKEN")
        if self._staged is None:
            raise Refusal(f"all parts of set {token} must come first", "INCOMPLETE")
        layers = self._staged
        self.committed = token
        self.drop()
        return layers

    def drop(self) -> None:
        """Discard everything not committed."""
        self._parts = Assembly()
        self._staged = None

    def forget(self) -> None:
        """Discard everything, including the token committed last."""
        self.drop()
        self.committed = 0

    def _under_way(self, now: float) -> int:
        """Return the token of the collected or staged set, 0 for none."""
        if self._parts.is_expired(now):
            self.drop()
        return self._parts.token

    def _checked(self, stream: Sequence[int]) -> Layers:
        """Return the layers of a complete set; raises Refusal."""
        if len(stream) > self.capabilities["set_words"]:
            room = self.capabilities["set_words"]
            raise Refusal(f"a set must have at most {room} words", "BAD_LENGTH")
        return unpack_layers(stream, self.capabilities)
